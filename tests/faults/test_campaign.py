"""A short fault campaign; `make faults` runs the long one."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from store import open_log
from tests.faults.bits import flip_many
from tests.faults.campaign import KINDS, Campaign, on_disk, run
from tests.faults.rivals import rounds_of_rivalry

SEED = 52
"""Seed whose first rounds bring every kind of fault."""


@pytest.fixture
def disk() -> Iterator[Path]:
    with on_disk() as folder:
        yield folder


def test_nothing_acknowledged_is_lost_or_doubled_whatever_is_killed(disk: Path) -> None:
    tally = run(6, SEED, disk / "log")
    assert tally.wrong == []
    assert (tally.lost, tally.doubled) == (0, 0)
    assert len(tally.rounds) == len(KINDS)
    assert tally.stored >= tally.acknowledged > 50


def test_the_campaign_would_notice_a_lost_and_a_doubled_event(disk: Path) -> None:
    campaign = Campaign(disk / "log", SEED)
    try:
        campaign.round()
        stream = next(iter(campaign._acknowledged))
        campaign._heads[stream] += 1
        while campaign._acknowledged[stream] < campaign._heads[stream]:
            campaign._hear(campaign._appender)
        campaign._acknowledged[stream] += 1000
        campaign._check_new()
        assert campaign.tally.lost > 0
        assert campaign.tally.doubled > 0
        assert not campaign.tally.is_clean
    finally:
        campaign.close()


def test_every_flipped_bit_is_found_and_located(disk: Path) -> None:
    open_log(data_dir=disk / "log").close()
    flips = flip_many(disk / "log", SEED, 15, 3)
    assert [each.where for each in flips if not each.is_found] == []
    assert [each.where for each in flips if not each.is_located] == []


def test_of_two_writers_at_one_place_of_a_stream_one_wins_and_the_other_is_told(disk: Path) -> None:
    open_log(data_dir=disk / "log").close()
    assert rounds_of_rivalry(disk / "log", SEED, 2) == []
