"""A short fault campaign of sync; `make faults-sync` runs the long one."""

import random
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.faults.campaign import on_disk
from tests.faults.sync_campaign import ALONE, FAULTS, FAULTS_IN_FULL, TIMES, Campaign, schedule

SEED = 5
ROUNDS = (
    ("daemon killed", "central killed"),
    ("station's PostgreSQL stopped", "central's PostgreSQL stopped", "clock jumped"),
    ("two daemons", "link down"),
    ("central frozen", "daemon killed"),
)


@pytest.fixture
def disk() -> Iterator[Path]:
    with on_disk() as folder:
        yield folder


@pytest.mark.slow
def test_nothing_acknowledged_is_lost_or_doubled_between_a_station_and_central(disk: Path) -> None:
    campaign = Campaign(disk, SEED)
    try:
        for kinds in ROUNDS:
            campaign.round(*kinds)
        campaign.finish()
    finally:
        campaign.close()
    tally = campaign.tally
    assert tally.wrong == []
    assert (tally.lost, tally.doubled) == (0, 0)
    assert tally.cuts > 0
    assert tally.held >= tally.acknowledged > 50

    # And it would have noticed.
    key = next(iter(campaign._ledger))
    campaign._count_lost(key, campaign._ledger[key] + 1000)
    assert 900 < tally.lost <= 1000, "an event may be there that nobody was told of"
    assert not tally.is_clean


def test_a_schedule_brings_each_fault_as_often_as_is_wanted() -> None:
    rounds = schedule(FAULTS_IN_FULL, random.Random(1))
    counts = {kind: sum(kind in kinds for kinds in rounds) for kind in FAULTS}
    assert counts == TIMES
    assert all(len(kinds) == 1 for kinds in rounds if set(kinds) & set(ALONE))
