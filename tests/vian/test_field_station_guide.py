"""What the guide to a field station hands out is usable as it stands: its plan, its program, settings and units."""

import re
from pathlib import Path

import pytest

from events import Catalogue
from store import Log
from sync.plans.checking import check_filters, warnings_of
from sync.plans.plan import Plan
from tests.vian.conftest import Run
from tests.vian.samples import objects
from vian.settings import load_settings

GUIDES = Path(__file__).parents[2] / "docs" / "guides"
GUIDE = (GUIDES / "field-station.md").read_text()


def block(kind: str) -> str:
    (found,) = re.findall(rf"^```{kind}\n(.*?)^```$", GUIDE, re.MULTILINE | re.DOTALL)
    return str(found)


def test_the_plan_fits_the_types_and_says_nothing_in_vain() -> None:
    plan = Plan.parse(block("yaml"), "plan.yaml")
    check_filters(plan, Catalogue.shipped())
    assert warnings_of(plan) == []
    assert plan.give_up


def test_the_program_records_a_plate_that_is_found(log: Log, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VIAN_DSN", log.dsn)
    monkeypatch.setenv("VIAN_STATION", "brno-2")
    exec(compile(block("python"), "plate.py", "exec"), {})
    found, *_ = objects(run("find", "plate", "1AB*", "--json").out)
    assert (found["plate"], found["station"]) == ("1AB2345", "brno-2")


@pytest.mark.parametrize("role", ["station", "central"])
def test_unit_and_settings_of_each_role_belong_together(role: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VIAN_CONFIG", str(GUIDES / "systemd" / f"{role}.toml"))
    settings = load_settings()
    assert settings.data_dir == Path("/var/lib/vian")
    unit = (GUIDES / "systemd" / f"vian-{role}.service").read_text()
    assert f"vian serve --role {role} " in unit
    for line in ("Environment=VIAN_CONFIG=/etc/vian/vian.toml", "StateDirectory=vian", "ProtectSystem=strict"):
        assert line in unit.splitlines()
    assert (settings.tls == "generate") == (role == "central")
