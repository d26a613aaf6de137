"""Settings: from the command line, the environment (`VIAN_...`), `vian.toml`, and defaults, in this order.

Contract: read once, frozen, passed on. A key that is not a setting is refused.
"""

import os
import re
import socket
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

import platformdirs
from pydantic import AfterValidator, Field, SecretStr, ValidationError
from pydantic_settings import BaseSettings, PydanticBaseSettingsSource, SettingsConfigDict, TomlConfigSettingsSource

from vian.errors import WrongUsage

CONFIG_NAME = "vian.toml"


def at_home(path: Path) -> Path:
    """The path with ~ and ~NAME for the homes that they stand for.

    Raises:
        ValueError: Nobody of that name has a home here.
    """
    try:
        return path.expanduser()
    except RuntimeError as error:
        raise ValueError(f"{path.parts[0]} is nobody's home here") from error


HomePath = Annotated[Path, AfterValidator(at_home)]
"""A path in which ~ is the user's home, wherever it was written."""


def config_file() -> Path:
    """The settings file: `VIAN_CONFIG`, else `vian.toml` here, else the user's own.

    Raises:
        WrongUsage: `VIAN_CONFIG` names a file that is not there.
    """
    if named := os.environ.get("VIAN_CONFIG"):
        if not Path(named).is_file():
            raise WrongUsage(f"VIAN_CONFIG names {named}, which is not a file. Next: correct or unset it")
        return Path(named)
    here = Path(CONFIG_NAME)
    return here if here.exists() else platformdirs.user_config_path("vian") / CONFIG_NAME


def _host_name() -> str:
    cleaned = re.sub(r"[^A-Za-z0-9._-]+", "-", socket.gethostname())[:64].strip("._-")
    return cleaned or "station"


class Settings(BaseSettings):
    """What an installation can set."""

    model_config = SettingsConfigDict(
        env_prefix="VIAN_", frozen=True, extra="forbid", use_attribute_docstrings=True, env_ignore_empty=True
    )

    data_dir: HomePath = Field(default_factory=lambda: platformdirs.user_data_path("vian"))
    """folder of the embedded log; by default in the platform's folder for data (on Linux `~/.local/share/vian`)"""
    dsn: SecretStr | None = None
    """address of an external PostgreSQL instead of the embedded one: postgresql://user:password@host/database"""
    station: str = Field(default_factory=_host_name)
    """name of this station, the first part of its streams' names; the host's name by default"""
    data: HomePath = Path("../shared/data")
    """folder of sample videos for the demo and the tests"""
    rules: HomePath | None = None
    """folder or file of rules that `vian serve` runs"""
    rules_look_s: Annotated[float, Field(gt=0)] = 1.0
    """`vian serve` looks for changed rule files this often, in seconds"""
    rules_save_s: Annotated[float, Field(ge=0)] = 30.0
    """longest time between two saves of what rules remember, in seconds, while events come"""
    rules_save_events: Annotated[int, Field(ge=1)] = 1_000_000
    """most events between two saves of what rules remember"""
    rules_ahead_s: Annotated[float, Field(ge=0)] = 86_400.0
    """how far ahead of the log's clock and of its source an event may be to take part in rules, in seconds; 0: any"""
    rules_event_us: Annotated[float, Field(ge=0)] = 1_000.0
    """what a rule may take for an event, in microseconds, before it is set aside as too slow; 0: no limit"""
    rules_slow_windows: Annotated[int, Field(ge=1)] = 10
    """windows of 1,000 events in a row that a rule may be over that limit"""
    rules_finish_h: Annotated[float, Field(ge=0)] = 24.0
    """how long a retired rule without WITHIN may finish what it has begun, in hours of event time"""
    rules_partial_matches_max: Annotated[int, Field(ge=1)] = 10_000
    """partial matches of a rule in one partition; more are given up, which `rule_missed` says"""
    rules_partitions_max: Annotated[int, Field(ge=1)] = 1_000_000
    """partitions that rules remember; of more, half are given up, those that were silent longest"""
    rules_expiry_h: Annotated[float, Field(ge=0)] = 0.0
    """hours of event time without a row after which a partition is given up, which `rule_missed` says; 0: never"""
    host: str = "127.0.0.1"
    """address that `vian serve` listens on"""
    port: Annotated[int, Field(ge=0, le=65535)] = 8470
    """port that `vian serve` listens on; 0 takes a free one"""
    metrics_public: bool = False
    """whether other machines too may read `/metrics` of `vian serve`; else this one alone"""
    central: str | None = None
    """address of the central server that `vian sync` replicates to, such as https://central.example:8470"""
    token_file: HomePath | None = None
    """file with this station's token for the central server"""
    stations_file: HomePath | None = None
    """central server: TOML file with the stations that may replicate, `name = "SHA-256 of its token"`"""
    tls: Literal["off", "generate"] = "off"
    """central server: `generate` makes a certificate, kept in data_dir, which stations know from their enrolment"""
    tls_certificate: HomePath | None = None
    """central server: file with the operator's certificate and its chain, PEM; https is served then"""
    tls_key: HomePath | None = None
    """central server: file with the certificate's key, PEM, without a password; by default in the same file"""
    token_minutes: Annotated[float, Field(gt=0, le=1440)] = 15.0
    """central server: how long a station speaks after a hello before it must say it again, in minutes"""
    invite_hours: Annotated[float, Field(gt=0)] = 24.0
    """central server: how long the one-time code of `vian station invite` can be used, in hours"""
    plan: HomePath | None = None
    """YAML or TOML file of the sync plan, set at each start of `vian sync`; else the plan that was set last counts"""
    key_file: HomePath | None = None
    """file of the station's key for signatures, made by `vian init`, mode 0600; `station.key` in data_dir by default"""
    sign_every_min: Annotated[float, Field(ge=0)] = 10.0
    """longest time between signed checkpoints of `vian serve` while events come, in minutes; 0: by segments alone"""
    sign_every_segments: Annotated[int, Field(ge=0)] = 100_000
    """most segments between signed checkpoints of `vian serve`; 0: by time alone"""
    archive: str | None = None
    """folder or URL that `vian archive` seals to; by default `archive` in the folder of the embedded log"""
    archive_after_days: Annotated[float, Field(ge=0)] = 30.0
    """how long a segment stays in PostgreSQL before `vian archive` seals it, in days"""
    archive_file_mb: Annotated[int, Field(ge=1)] = 64
    """about how large a sealed file becomes, in MB"""
    append_window_ms: Annotated[float, Field(ge=0, le=60_000)] = 100.0
    """longest wait of what live extractors append for others to share a commit with, in milliseconds"""
    append_events_max: Annotated[int, Field(ge=1)] = 10_000
    """events at which such a commit does not wait for the window"""
    journal: HomePath | None = None
    """file that keeps what live extractors append while the database is away; in data_dir by default"""
    database_wait_s: Annotated[float, Field(ge=0)] = 60.0
    """how long an append waits for a database that is away, in seconds"""
    disk_free_mb_min: Annotated[int, Field(ge=0)] = 256
    """what must stay free on an embedded log's disk, in MiB: else what the plan gives up goes, or recording stops"""
    prune_after_days: Annotated[float, Field(ge=0)] | None = None
    """age in days at which payloads that central countersigned leave this station's disk; never by default"""
    question_s: Annotated[float, Field(gt=0, le=45)] = 10.0
    """central server: longest time that a question from the field may take, in seconds; stations wait for 60"""
    question_rows_max: Annotated[int, Field(ge=1, le=10_000)] = 1_000
    """central server: most rows of an answer, or of a page of one"""
    question_answer_kb: Annotated[int, Field(ge=1, le=3_072)] = 2_048
    """central server: most that the rows of an answer may take, in kB; a row at most an eighth of it"""
    question_memory_mb: Annotated[int, Field(ge=1)] = 16
    """central server: memory of each sort or hash table of a question in PostgreSQL, in MB"""
    question_disk_mb: Annotated[int, Field(ge=1)] = 256
    """central server: what a question may put on PostgreSQL's disk meanwhile, in MB, where its owner may bound that"""
    questions_of_station_max: Annotated[int, Field(ge=1, le=8)] = 2
    """central server: questions of one station at a time"""
    questions_at_once_max: Annotated[int, Field(ge=1, le=8)] = 4
    """central server: questions of all stations at a time; each takes one of the log's 10 connections"""

    sync_latency_s: Annotated[float, Field(gt=0, le=60)] = 0.3
    """how long a request to central should take, in seconds: an alert waits about so long for what is under way"""
    sync_request_kb_max: Annotated[int, Field(ge=16, le=65_536)] = 2_048
    """most that the segments of one request to central take, in KiB; a larger segment goes alone"""
    sync_in_flight: Annotated[int, Field(ge=1, le=8)] = 2
    """requests with segments that are under way to central at once"""
    sync_hello_s: Annotated[float, Field(ge=1, le=86_400)] = 900.0
    """time without an answer of central's after which an idle station says hello, in seconds"""
    station_rate_kbps: Annotated[int, Field(ge=1)] | None = None
    """central server: most that each station may send, in kbit/s; without it, no limit"""

    rows_keep_days: Annotated[int, Field(ge=1)] | None = None
    """age in days at which a day's rows are dropped, by event time; never by default. Events stay in the log"""
    rows_keep_days_by_type: dict[str, Annotated[int, Field(ge=1)]] = Field(default_factory=dict)
    """the same for single event types, in place of rows_keep_days: `{ track_point = 30 }`"""
    rows_ahead_days: Annotated[int, Field(ge=0, le=31)] = 2
    """partitions of row tables made ahead of today, in days"""
    rows_close_after_h: Annotated[float, Field(ge=0, le=8760)] = 6.0
    """a day of rows gets its index for tracks and cameras so long after its end and its newest row, in hours"""
    rows_upkeep_s: Annotated[float, Field(ge=1, le=86400)] = 300.0
    """`vian serve` sees to the row tables (retention, partitions, closed days) this often, in seconds"""

    rows_wait_s: Annotated[float, Field(ge=0, le=3600)] = 10.0
    """`vian serve` lets rows wait so long while it stores what stations send as fast as they can, in seconds; 0: not"""

    live_connect_s: Annotated[float, Field(gt=0, le=600)] = 15.0
    """longest wait for the first picture of a live stream, in seconds"""
    live_stall_s: Annotated[float, Field(gt=0, le=600)] = 10.0
    """silence after which a live stream counts as interrupted and is tried again, in seconds"""
    live_retry_s_min: Annotated[float, Field(gt=0, le=3600)] = 1.0
    """pause before an interrupted live stream is tried again, in seconds; each failure doubles it ..."""
    live_retry_s_max: Annotated[float, Field(gt=0, le=3600)] = 60.0
    """... up to this, in seconds"""
    live_give_up_h: Annotated[float, Field(gt=0)] = 168.0
    """an interruption longer than this ends the extraction with an error, in hours"""
    live_queue_frames: Annotated[int, Field(ge=1, le=256)] = 8
    """pictures of a live stream that wait for the extractor; of more the oldest are left out, and counted"""
    live_ca_file: Path | None = None
    """certificates (PEM) that vouch for cameras of `rtsps` or `https`; by default no certificate is checked"""

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Command line before environment before file."""
        return init_settings, env_settings, TomlConfigSettingsSource(settings_cls, config_file())


def load_settings(**given: Any) -> Settings:
    """The settings, with what the command line gave on top; None means not given.

    Raises:
        WrongUsage: A setting is unknown or has a bad value.
    """
    try:
        return Settings(**{name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        raise WrongUsage(_explained(error)) from None  # a chained error would show what is secret
    except (tomllib.TOMLDecodeError, OSError) as error:
        raise WrongUsage(f"the settings file {config_file()} cannot be read: {error}") from error


def station_option(station: str) -> str:
    """What a command needs on its line to be about this station; empty where it is without."""
    return "" if station == load_settings().station else f" --station {station}"


def _explained(error: ValidationError) -> str:
    first = error.errors()[0]
    name = str(first["loc"][0])
    if first["type"] == "extra_forbidden":
        known = ", ".join(sorted(Settings.model_fields))
        return f"{config_file()}: there is no setting {name!r}; known: {known}. Next: correct or remove the line"
    # An address may hold a password, whatever else is wrong with it.
    got = "" if name == "dsn" else f", got {first['input']!r}"
    return (
        f"setting {name}: {first['msg']}{got}. "
        f"Next: correct it on the command line, in VIAN_{name.upper()} or in {config_file()}"
    )
