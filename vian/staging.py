"""Stages over the log: each follows it, derives, and appends what it derives as ordinary events.

Contract: a stage's events and its place in the log commit together, with all that it remembers, so an event is
appended exactly once whatever is killed when. A segment is one unit of arrival. Rules read what is derived from
the log. A deployed version never changes: another content under its number is refused.
"""

from collections.abc import Callable, Iterable, Sequence
from datetime import datetime
from pathlib import Path
from time import sleep

import pyarrow as pa
import structlog

from events import (
    Catalogue,
    Draft,
    EventBatch,
    ProcessFailed,
    ProcessFinished,
    Producer,
    Segment,
    StageDeployed,
    StreamName,
    UnknownType,
    VideoAdded,
    batch_of,
    decode,
    encode,
    events_of,
    schema_of,
    with_envelope,
)
from patterns.errors import PatternError, StateError
from patterns.files.loading import is_stage_file, yaml_files
from patterns.stages import Derived, Stage, StageRun, load_stages
from store import Log, Subscription
from vian.clock import utc_now
from vian.errors import WrongUsage
from vian.parts import Part, stepping

logger = structlog.get_logger()

SOURCE = "stages"
"""Source of the deployments of stages."""
_CONTROL = (VideoAdded, ProcessFinished, ProcessFailed)
_STEP_SECONDS = 1.0


def stages_of(paths: Sequence[Path]) -> list[Stage]:
    """The stages of files and folders, in order.

    Raises:
        WrongUsage: Two of one name, or a file cannot be read.
        PatternError: A file is not a stage.
    """
    try:
        stages = [stage for path in paths for stage in load_stages(path)]
    except OSError as error:
        raise WrongUsage(f"the stage file {error.filename} cannot be read: {error.strerror}") from error
    names = [stage.stage for stage in stages]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise WrongUsage(f"two stages are named {twice[0]}. Next: rename one")
    return stages


def stages_beside(rules: Path) -> list[Path]:
    """The files of stages among the rules of a file or folder."""
    return [file for file in yaml_files(rules) if is_stage_file(file)]


def stages_beside_that_run(log: Log, station: str, rules: Path) -> list[Stage]:
    """The stages among the rules of a file or folder, deployed; one that cannot run is named and left out."""
    stages: dict[str, Stage] = {}
    for path in stages_beside(rules):
        try:
            (stage,) = stages_of([path])
            if stage.stage in stages:
                raise WrongUsage(f"the stage {stage.stage!r} is also defined in {stages[stage.stage].path}")
            check_fits(stage, log.catalogue)
            deploy_stages(log, station, [stage])
        except (PatternError, WrongUsage) as error:
            logger.error("a stage file is left out; the others run", file=str(path), error=str(error))
            continue
        stages[stage.stage] = stage
    return list(stages.values())


def check_fits(stage: Stage, catalogue: Catalogue) -> None:
    """Nothing, if the stage reads an event type and columns that there are.

    Raises:
        RuleError: It does not; at its place in the file.
    """
    if stage.reads not in catalogue:
        have = ", ".join(sorted(str(each.type_name) for each in catalogue))
        raise stage.error(f"unknown event type {stage.reads!r}; there are: {have}", stage.derives, "of")
    columns = {*schema_of(catalogue.newest(stage.reads)).names, "subject", "station"}
    if stage.tally is not None and stage.tally.by is not None and stage.tally.by not in columns:
        have = ", ".join(sorted(columns))
        raise stage.error(f"unknown column {stage.tally.by!r} of {stage.reads}; there are: {have}", "tally", "by")


def deploy_stages(log: Log, station: str, stages: Sequence[Stage]) -> list[Stage]:
    """Record the stages as deployed where they are new; those that were new.

    Raises:
        PatternError: A version that was deployed before now has another content.
    """
    stream = StreamName.of(station, SOURCE, StageDeployed.type_name)
    deployed = {
        (event.stage, event.stage_version): event.stage_hash
        for segment in log.read_lives(stream)
        for event in events_of(decode(segment, log.catalogue))
        if isinstance(event, StageDeployed)
    }
    new = []
    for stage in stages:
        known = deployed.get((stage.stage, stage.version))
        if known is None:
            new.append(stage)
        elif known != stage.hash:
            raise PatternError(
                f"stage {stage.stage} version {stage.version} is deployed with another content: deployed hash "
                f"{known[:12]}, this file's {stage.hash[:12]}. Next: give the changed stage a new version"
            )
    for stage in new:
        text = stage.path.read_text(encoding="utf-8") if stage.path else stage.model_dump_json()
        event = StageDeployed(
            time=utc_now(), stage=stage.stage, stage_version=stage.version, stage_hash=stage.hash, text=text
        )
        log.append([encode(stream, batch_of([event]), _producer(stage))])
    return new


class StageFollower:
    """One stage over one log. Not for several threads at once."""

    def __init__(self, log: Log, station: str, stage: Stage, now: Callable[[], datetime] | None = None) -> None:
        """Go on where the stage's checkpoint stands.

        Args:
            log: The log.
            station: This station, in whose streams the derived events go.
            stage: The stage.
            now: The clock on the wall, by which `time.idle` is judged; None: a silent source holds the others
                until its process ends.

        Raises:
            PatternError: It reads an event type that there is not.
        """
        check_fits(stage, log.catalogue)
        self.stage = stage
        self.failure: PatternError | None = None
        """Why it was set aside; None: it runs."""
        self._log = log
        self._station = station
        self._now = now
        self._is_stale = False
        self._name = f"stage/{station}/{stage.stage}/{stage.version}"
        types = sorted({stage.reads, *(str(each.type_name) for each in _CONTROL)})
        self._subscription = Subscription(log, self._name, types=types)
        self._begin()

    @property
    def run(self) -> StageRun:
        """What it remembers and counts."""
        return self._run

    def step(self, timeout_s: float = 0.0) -> bool:
        """Derive from the next segments, waiting up to `timeout_s` seconds for some; whether those are all.

        A stage that cannot go on is set aside, and its `failure` says why.

        Raises:
            LogUnavailable: The database is away; nothing is lost, step again later.
        """
        if self.failure is not None:
            return True
        if self._is_stale:
            self._begin()
        before = self._subscription.position
        delivery = self._subscription.poll(timeout_s)
        self._is_stale = True  # until the commit, what is remembered is ahead of the log
        try:
            derived = [each for segment in delivery.segments for each in self._taken(segment)]
            if delivery.is_caught_up and self._now is not None and self.stage.time.idle is not None:
                derived += self._run.advance_idle(self._now()).derived
        except PatternError as error:
            self.failure = error
            logger.error("stage set aside", stage=self.stage.stage, error=str(error))
            return True
        if (delivery.segments or derived) and not self._save(before, delivery.position, derived):
            logger.warning("another program moved this stage on; going on from the log", stage=self.stage.stage)
            return False
        self._is_stale = False
        return delivery.is_caught_up

    def catch_up(self) -> None:
        """Derive from all that is there now."""
        while not self.step():
            pass

    def close(self) -> None:
        """Stop listening."""
        self._subscription.close()

    def _begin(self) -> None:
        checkpoint = self._log.checkpoint(self._name)
        self._run = StageRun(self.stage)
        if checkpoint.state:
            try:
                self._run.restore(checkpoint.state)
            except StateError as error:
                raise StateError(f"stage {self.stage.stage}: {error}. Next: give it a new version") from error
        self._subscription.position = checkpoint.position
        self._is_stale = False

    def _taken(self, segment: Segment) -> tuple[Derived, ...]:
        try:
            batch = decode(segment, self._log.catalogue)
        except UnknownType as error:
            logger.warning("a stage leaves a segment out", position=segment.position, error=str(error))
            return ()
        if segment.stream.type == self.stage.reads:
            over = self._run.given_up
            outcome = self._run.push(with_envelope(segment.stream, segment.header.first_sequence, batch))
            if outcome.late or self._run.given_up > over:
                logger.warning(
                    "a stage goes without some events", stage=self.stage.stage, position=segment.position,
                    late=outcome.late, over_a_limit=self._run.given_up - over,
                )  # fmt: skip
            return outcome.derived
        source = str(segment.stream.source)
        derived: list[Derived] = []
        for event in events_of(batch):
            if isinstance(event, VideoAdded):
                self._run.set_frame_size(source, event.width, event.height)
            else:
                derived += self._run.source_ended(source).derived
        return tuple(derived)

    def _save(self, before: int, position: int, derived: Iterable[Derived]) -> bool:
        """Append what was derived and move on, all or nothing; False if another program has moved on."""
        drafts = self._drafts(derived)
        with self._log.transaction() as transaction:
            if transaction.checkpoint(self._name).position != before:
                return False
            transaction.save_checkpoint(self._name, position, self._run.state())
            transaction.append(drafts)
        return True

    def _drafts(self, derived: Iterable[Derived]) -> list[Draft]:
        """One draft for each source, its events in order."""
        by_source: dict[str, list[EventBatch]] = {}
        for each in derived:
            by_source.setdefault(each.source, []).append(each.batch)
        return [
            encode(StreamName.of(self._station, source, self.stage.derives), _joined(batches), _producer(self.stage))
            for source, batches in by_source.items()
        ]


def stages_part(log: Log, station: str, stages: Sequence[Stage]) -> Part:
    """Stages as one supervised part, deployed."""
    followers = [StageFollower(log, station, stage, now=utc_now) for stage in stages]
    deploy_stages(log, station, stages)

    def step() -> None:
        are_caught_up = [follower.step() for follower in followers]
        if all(are_caught_up):
            _wait(followers)

    def close() -> None:
        for follower in followers:
            follower.close()

    return stepping("stages", step, log, close)


def _wait(followers: Sequence[StageFollower]) -> None:
    """Wait a while for something to do; a stage that was set aside waits for nothing."""
    alive = next((each for each in followers if each.failure is None), None)
    if alive is None:
        sleep(_STEP_SECONDS)
    else:
        alive.step(_STEP_SECONDS)


def _joined(batches: Sequence[EventBatch]) -> EventBatch:
    table = pa.Table.from_batches([each.data for each in batches]).combine_chunks()
    return EventBatch(batches[0].type, table.to_batches()[0])


def _producer(stage: Stage) -> Producer:
    return Producer(f"stage/{stage.stage}", str(stage.version), bytes.fromhex(stage.hash))
