"""Whatever happens in whatever order, central holds a part of the station's history, and in the end all of it.

A state machine drives daemons by hand, over real HTTP and PostgreSQL. Each example has a station and a
central of its own; central may be lost and come back as it was at an earlier moment.
"""

import os
from datetime import timedelta
from itertools import count
from typing import Any

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from events import Catalogue, Place
from store import Log, verify
from sync import Daemon, Pace, Plan, SessionOver
from sync.plans.planning import set_plan
from tests.conftest import Server
from tests.sync.conftest import (
    BRNO,
    EVERYTHING,
    NOON,
    Faults,
    MakeDaemon,
    Switchboard,
    append_points,
    central_app,
    heads,
    stored,
    stream_of,
)

EXAMPLES = int(os.environ.get("VIAN_SYNC_EXAMPLES", "6"))
SOURCES = ("gate", "yard", "dock")
LATER, LATEST = (str(NOON + timedelta(milliseconds=n)) for n in (25, 60))
PLANS = tuple(
    Plan.of({"entries": entries})
    for entries in (
        [{"stream": "*/*/*"}],
        [{"stream": "*/gate/*"}],
        [{"stream": "*/yard/*", "priority": "alerts"}, {"stream": "*/*/*", "priority": "media"}],
        [{"stream": "*/gate/*", "from": LATER}, {"stream": "*/yard/*", "from": LATEST, "priority": "alerts"}],
        [{"stream": "*/gate/*", "send": "false"}, {"stream": "*/*/*", "from": LATEST, "order": "live"}],
        [{"stream": "*/*/*", "order": "live"}],
    )
)
DAEMONS_MAX = 2
AFTER = NOON + timedelta(seconds=1)
"""The station's time: a plan may ask for what was, not for what will be."""
STEPS_MAX = 1000
"""More steps than are needed for what an example can leave undone: each sends something, waits for it or says hello."""
_SEEDS = count()
"""Of the daemons' randomness, by which their requests have names of their own."""


class Central:
    """A central server that can be restarted, and restored as it was."""

    def __init__(self, server: Server, board: Switchboard, name: str) -> None:
        self._server, self._board, self._name = server, board, name
        self._databases: list[str] = []
        self._saved: str | None = None
        self._open(None)

    def restart(self) -> None:
        """Close its log and serve it anew."""
        self._close()
        self._serve(self._databases[-1])

    def save(self) -> None:
        """Remember how it is."""
        self._close()
        self._saved = self._clone(self._databases[-1])
        self._serve(self._databases[-1])

    def restore(self) -> None:
        """Be as it was when it was saved, or empty."""
        self._close()
        self._open(self._saved)

    def drop(self) -> None:
        """End it, and take its databases away."""
        self._close()
        for name in self._databases:
            self._server.drop_database(name)

    def _open(self, template: str | None) -> None:
        self._serve(self._clone(template))

    def _clone(self, template: str | None) -> str:
        name = self._server.create_database(template) if template else self._server.create_database()
        self._databases.append(name)
        return name

    def _serve(self, database: str) -> None:
        self._databases.remove(database)
        self._databases.append(database)
        self.log = Log(self._server.dsn(database), Catalogue.shipped())
        self._board.apps[self._name] = central_app(self.log)

    def _close(self) -> None:
        self.log.close()
        self._server.execute(
            f"select pg_terminate_backend(pid, 10000) from pg_stat_activity where datname = '{self._databases[-1]}'"
        )


class Sync(RuleBasedStateMachine):
    """One station, up to two daemons of it, any link, and central."""

    make_daemon: MakeDaemon
    faults: Faults
    server: Server
    board: Switchboard
    address: str

    @initialize(request_bytes=st.sampled_from([1, 700, 5000, 256 * 1024]), in_flight=st.sampled_from([1, 1, 2]))
    def begin(self, request_bytes: int, in_flight: int) -> None:
        self.pace = Pace(request_bytes, request_bytes, in_flight=in_flight, backoff_s=0.001, backoff_s_max=0.002)
        self.database = self.server.create_database()
        self.log = Log(self.server.dsn(self.database), Catalogue.shipped())
        self.central = Central(self.server, self.board, "model")
        self.plan = EVERYTHING
        self.daemons = [self._daemon()]
        self.chain: dict[Place, dict[int, bytes]] = {}
        self.held: dict[Place, int] = {}
        self.excused: set[Daemon] = set()

    def _daemon(self) -> Daemon:
        return type(self).make_daemon(
            log=self.log,
            plan=self.plan,
            address=self.address,
            pace=self.pace,
            seed=next(_SEEDS),
            now=lambda: AFTER,
        )

    # What the station and its link do.

    @rule(source=st.sampled_from(SOURCES), counts=st.lists(st.integers(1, 20), min_size=1, max_size=4))
    def append(self, source: str, counts: list[int]) -> None:
        append_points(self.log, stream_of(source), counts)

    @rule(which=st.integers(0, DAEMONS_MAX - 1))
    def step(self, which: int) -> None:
        self._step(which)

    @rule(which=st.integers(0, DAEMONS_MAX - 1), fault=st.sampled_from(Faults.KINDS), where=st.floats(0, 1))
    def step_through_a_fault(self, which: int, fault: str, where: float) -> None:
        self.faults.next, self.faults.where = fault, where
        self._step(which)
        self.faults.next = None

    @rule(where=st.floats(0, 1))
    def an_old_request_arrives(self, where: float) -> None:
        self.faults.deliver_again(where)

    @rule()
    def kill_the_daemons(self) -> None:
        self.daemons = [self._daemon()]

    @precondition(lambda self: len(self.daemons) < DAEMONS_MAX)
    @rule()
    def begin_another_daemon(self) -> None:
        self.daemons.append(self._daemon())

    @rule(plan=st.sampled_from(PLANS))
    def change_the_plan(self, plan: Plan) -> None:
        """As an operator does: the daemons find it in the log, whatever they have under way."""
        self.plan = plan
        set_plan(self.log, BRNO, plan, self.address, NOON + timedelta(hours=1))

    # What central does.

    @rule()
    def restart_central(self) -> None:
        self.central.restart()

    @rule()
    def back_central_up(self) -> None:
        self.central.save()

    @rule()
    def restore_central(self) -> None:
        self.central.restore()
        self.held = {}
        self.excused = set(self.daemons)

    # What holds.

    @invariant()
    def central_holds_a_part_of_the_stations_history(self) -> None:
        if not hasattr(self, "daemons"):
            return
        self._read_on()
        for key, runs in self.central.log.all_runs(station=BRNO).items():
            for run in runs:
                chain = {0: bytes(32), **self.chain[key]}
                assert chain[run.after] == run.after_hash
                assert chain[run.sequence] == run.chain_hash

    @invariant()
    def nothing_that_central_held_is_gone(self) -> None:
        if hasattr(self, "daemons"):
            held, self.held = self.held, events_at(self.central.log)
            assert all(self.held.get(key, 0) >= events for key, events in held.items())

    def teardown(self) -> None:
        if not hasattr(self, "daemons"):
            return
        try:
            self._converge()
        finally:
            self.central.drop()
            self.log.close()
            self.server.drop_database(self.database)
            self.faults.forget()

    def _converge(self) -> None:
        """With a good link and all that there is planned, central comes to hold all in so many steps."""
        self.change_the_plan(EVERYTHING)
        daemon = self._daemon()
        for _ in range(STEPS_MAX):
            step = daemon.step()
            assert step.error is None or isinstance(step.error, SessionOver)
            if step.did == "nothing":
                break
        assert by_sequence(self.central.log) == by_sequence(self.log)
        assert heads(self.central.log) == heads(self.log)
        assert all(stream.backlog == 0 for stream in daemon.status().streams)
        assert verify(self.central.log).is_sound

    def _step(self, which: int) -> None:
        daemon = self.daemons[which % len(self.daemons)]
        hit = self.faults.next
        step = daemon.step()
        assert step.did != "stopped"
        # A daemon learns from one refusal that central is not what it was.
        is_allowed = step.error is None or isinstance(step.error, SessionOver) or daemon in self.excused
        # Of several under way, one may be hit that an earlier step launched.
        assert hit is not None or is_allowed or self.pace.in_flight > 1, repr(step.error)
        if step.error is not None:
            self.excused.discard(daemon)

    def _read_on(self) -> None:
        """Note the chain of what the station appended."""
        for stream, epoch, sequence, _ in heads(self.log):
            known = self.chain.setdefault((stream, epoch), {})
            if sequence not in known:
                for segment in self.log.read(stream, max(known, default=0) + 1, epoch=epoch):
                    known[segment.header.last_sequence] = segment.chain_hash


def by_sequence(log: Log) -> dict[str, list[tuple[Any, ...]]]:
    """All that a log holds of the station, byte by byte, in order of sequence: gaps are filled later."""
    return {name: sorted(held, key=lambda each: each[0].first_sequence) for name, held in stored(log).items()}


def events_at(log: Log) -> dict[Place, int]:
    """How many events of each stream a log holds."""
    return {key: sum(run.sequence - run.after for run in runs) for key, runs in log.all_runs(station=BRNO).items()}


def test_whatever_happens_in_whatever_order_the_two_sides_converge(
    make_daemon: MakeDaemon, faults: Faults, server: Server, switchboard: tuple[str, Switchboard]
) -> None:
    address, board = switchboard
    given: dict[str, Any] = {
        "make_daemon": staticmethod(make_daemon),
        "faults": faults,
        "server": server,
        "board": board,
        "address": f"{address}/model",
    }
    run_state_machine_as_test(
        type("Machine", (Sync,), given),
        settings=settings(max_examples=EXAMPLES, stateful_step_count=30, suppress_health_check=list(HealthCheck)),
    )
