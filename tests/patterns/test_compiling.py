"""The kernel is compiled beside a program that begins, harms nothing where it cannot be, and leaves nothing behind."""

import sys
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from patterns import RuleSetRun, bind, match
from patterns.engine import compiling, kernel
from patterns.engine.compiling import compiling_beside
from patterns.engine.jit import compiled, compiled_with_memory
from patterns.engine.ruleset import merged
from tests.patterns.samples import SCHEMAS, define_letters, letter_rule, letters


def _reaper() -> threading.Thread | None:
    return next((each for each in threading.enumerate() if each.name == "compiling"), None)


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What is run in place of the compiler, of a kernel that is not compiled."""
    monkeypatch.setattr(compiling, "_marker", lambda: tmp_path / "kernel.compiled")
    path = tmp_path / "compiler"
    monkeypatch.setattr(sys, "executable", str(path))
    return path


def _write(path: Path, script: str) -> None:
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)


def test_a_failure_to_compile_is_told_once_with_the_next_command(
    program: Path, caplog: pytest.LogCaptureFixture
) -> None:
    _write(program, "echo no compiler here >&2; exit 3")
    with compiling_beside():
        if (reaper := _reaper()) is not None:
            reaper.join()
    (told,) = caplog.messages
    assert "not compiled (exit 3)" in told
    assert "Next: python -m patterns.engine.compiling. It said: no compiler here" in told


def test_what_is_not_done_at_the_end_is_ended_and_nothing_is_told(
    program: Path, caplog: pytest.LogCaptureFixture
) -> None:
    _write(program, "exec sleep 600")
    with compiling_beside():
        assert _reaper() is not None
    assert _reaper() is None
    assert caplog.messages == []


def test_a_kernel_that_is_compiled_is_not_compiled_again(program: Path, tmp_path: Path) -> None:
    (tmp_path / "kernel.compiled").touch()
    with compiling_beside():
        assert _reaper() is None


def test_where_numba_can_keep_nothing_functions_are_compiled_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    names: dict[str, Any] = {}
    exec("def one_more(number):\n    return number + 1", names)  # a function of no file has no place in the cache
    assert compiled(names["one_more"])(1) == compiled_with_memory(names["one_more"])(1) == 2
    monkeypatch.setattr(kernel, "run", SimpleNamespace(stats=SimpleNamespace(cache_path=None)))
    compiling._marker.cache_clear()
    assert not compiling.is_compiled()
    with compiling_beside():
        assert _reaper() is None, "what cannot be kept is not worth compiling beside"
    compiling._marker.cache_clear()


def test_a_rule_that_comes_when_the_kernel_is_compiled_runs_on_it(monkeypatch: pytest.MonkeyPatch) -> None:
    compiling.compile_kernel()
    rule = letter_rule("A B", define_letters("AB"))
    bounds = [bind(rule.model_copy(update={"rule": name}), SCHEMAS) for name in ("before", "after")]
    group = RuleSetRun()
    for is_compiled, bound in zip((False, True), bounds, strict=True):
        monkeypatch.setattr(compiling, "is_compiled", lambda is_it=is_compiled: is_it)
        group.add(bound)
    assert [group.state(name)[:4] for name in group.rules] == [b"VRS1", b"VRS2"]


def test_rules_go_on_on_the_kernel_once_it_is_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    compiling.compile_kernel()
    rule = letter_rule("A B", define_letters("AB"), more="time: {lateness: 0 s}")
    ahead = letter_rule("A", "A AS n < NEXT(n)").model_copy(update={"rule": "ahead"})
    bounds = [bind(each, SCHEMAS) for each in (rule, ahead)]
    rows = letters("caacba")
    monkeypatch.setattr(compiling, "is_compiled", lambda: False)
    group = RuleSetRun(bounds)
    steps = [group.push(rows.slice(0, 4))]
    group.use_kernel()
    assert [group.state(name)[:4] for name in group.rules] == [b"VRS1", b"VRS1"], "it is not compiled yet"
    monkeypatch.setattr(compiling, "is_compiled", lambda: True)
    for begin in (4, 5):
        group.use_kernel()
        assert [group.state(name)[:4] for name in group.rules] == [b"VRS2", b"VRS1"], "it does not look ahead"
        steps.append(group.push(rows.slice(begin, 1)))
    found = merged([*steps, group.finish()])
    assert {name: list(each.matches) for name, each in found.items()} == {
        bound.rule.rule: match(bound, rows) for bound in bounds if match(bound, rows)
    }


def test_what_ran_on_the_kernel_goes_on_where_it_is_not_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    compiling.compile_kernel()
    bound = bind(letter_rule("A B", define_letters("AB"), more="time: {lateness: 0 s}"), SCHEMAS)
    group = RuleSetRun([bound], uses_kernel=True)
    rows = letters("cacab")
    steps = [group.push(rows.slice(0, 4))]
    monkeypatch.setattr(compiling, "is_compiled", lambda: False)
    restored = RuleSetRun()
    restored.add(bound, group.state("sample"))
    assert restored.state("sample").startswith(b"VRS1")
    found = merged([*steps, restored.push(rows.slice(4)), restored.finish()])
    assert list(found["sample"].matches) == match(bound, rows) != []


def test_a_rule_that_cannot_be_moved_to_the_kernel_goes_on_and_the_others_move(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    compiling.compile_kernel()
    rule = letter_rule("A B", define_letters("AB"), more="time: {lateness: 0 s}")
    bounds = [bind(rule.model_copy(update={"rule": name}), SCHEMAS) for name in ("stuck", "moves")]
    monkeypatch.setattr(compiling, "is_compiled", lambda: False)
    group = RuleSetRun(bounds)
    rows = letters("cacab")
    steps = [group.push(rows.slice(0, 4))]
    monkeypatch.setattr(compiling, "is_compiled", lambda: True)
    with monkeypatch.context() as broken:
        broken.setattr(group._alone["stuck"], "state", lambda: [][0])
        group.use_kernel()
        group.use_kernel()
    assert caplog.text.count("rule stuck goes on without the kernel: list index out of range") == 1
    assert [group.state(name)[:4] for name in group.rules] == [b"VRS1", b"VRS2"]
    found = merged([*steps, group.push(rows.slice(4)), group.finish()])
    assert {name: list(each.matches) for name, each in found.items()} == {
        bound.rule.rule: match(bound, rows) for bound in bounds
    }
    assert not group.failures
