"""Rule files that are watched: what changes in them is deployed while the rules run.

Contract: a file that is not a rule, or says another rule under a version that is deployed, is named and
changes nothing of what runs, at the start too; it is tried again when another file changes, for it may read the
situations of that one. A file that was removed retires its rule, which still finishes what it has begun; one that
is missing for a moment only, as editors leave it, does not.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

import structlog

from patterns.binding.binder import bind
from patterns.errors import PatternError
from patterns.files.loading import load_rule, rule_files
from patterns.files.rule import Rule
from patterns.processor import Processor, ProcessorLimits, readable_by, retire, standing
from store import Log
from vian.clock import utc_now
from vian.errors import WrongUsage
from vian.parts import Part, stepping
from vian.rules import deploy_all, doubts

logger = structlog.get_logger()

LOOK_SECONDS = 1.0
"""How often rule files are looked at, unless the settings say otherwise."""
_STEP_SECONDS = 1.0

Stamp = tuple[int, int]
"""When a file was changed, in nanoseconds, and its size: another stamp is another content."""


def processor_part(
    log: Log,
    station: str,
    path: Path | None,
    limits: ProcessorLimits | None = None,
    look_s: float = LOOK_SECONDS,
) -> Part:
    """The deployed rules as a supervised part; those of a file or folder are deployed, also when they change."""
    paths = [] if path is None else [path]
    watch = RulesWatch(log, station, paths, monotonic, look_s)
    watch.look()
    processor = Processor(log, station, now=utc_now, limits=limits)

    def step() -> None:
        watch.look()
        processor.step(_STEP_SECONDS)

    return stepping("rules", step, log, processor.close)


def check_there(path: Path | None) -> None:
    """Nothing, if there is a rule file or folder to watch; an empty folder may be filled later.

    Raises:
        WrongUsage: There is none.
    """
    if path is not None and not path.exists():
        raise WrongUsage(f"there is no {path} to read rules from. Next: mkdir {path}, or give another folder or file")


@dataclass(frozen=True, slots=True)
class _Seen:
    stamp: Stamp
    rule: str | None
    """name of the rule that the file said; None: it said none"""


class RulesWatch:
    """Files and folders of rules, looked at again and again. Not for several threads at once."""

    def __init__(
        self, log: Log, station: str, paths: Sequence[Path], clock: Callable[[], float], every_s: float
    ) -> None:
        """Look at nothing yet.

        Args:
            log: The log that says which rules run.
            station: This station.
            paths: Rule files, and folders of them.
            clock: Seconds that never go back.
            every_s: Shortest time between two looks, in seconds.
        """
        self._log = log
        self._station = station
        self._paths = list(paths)
        self._clock = clock
        self._every_s = every_s
        self._next_s = clock()
        self._seen: dict[Path, _Seen] = {}
        self._missing: set[Path] = set()

    def look(self) -> int:
        """Deploy what is new or changed, retire what was removed, if it is time to look; how many rules that were.

        Raises:
            LogUnavailable: The database is away; what changed is deployed by a later look.
        """
        if self._clock() < self._next_s:
            return 0
        self._next_s = self._clock() + self._every_s
        stamps = self._stamps()
        changed = [path for path, stamp in stamps.items() if path not in self._seen or self._seen[path].stamp != stamp]
        gone = [path for path in self._seen if path not in stamps]
        count = 0
        if changed:
            count += self._deploy({path: stamps[path] for path in changed}, stamps)
        for path in gone:
            count += self._remove(path)
        self._missing = {path for path in gone if path in self._seen}
        return count

    def _stamps(self) -> dict[Path, Stamp]:
        """The files there are now. One that vanishes between two calls is not there."""
        found: dict[Path, Stamp] = {}
        for path in self._paths:
            try:
                files = rule_files(path)
            except OSError as error:
                logger.error("the folder of rules cannot be read", path=str(path), error=str(error))
                continue
            for file in files:
                try:
                    stat = file.stat()
                except FileNotFoundError:
                    continue
                found[file] = (stat.st_mtime_ns, stat.st_size)
        return found

    def _deploy(self, changed: Mapping[Path, Stamp], stamps: Mapping[Path, Stamp]) -> int:
        """Deploys the files that changed, and those left out before; how many rules that were.

        A rule that reads the situations of another is a rule once that one is, in whatever order files come.
        """
        left_out = [path for path, each in self._seen.items() if each.rule is None and path in stamps]
        waiting = list(dict.fromkeys([*changed, *left_out]))
        names = {each.rule: path for path, each in self._seen.items() if path in stamps and path not in waiting}
        count, wrong = 0, dict[Path, Exception]()
        while waiting:
            wrong = {}
            for path in waiting:
                try:
                    rule = self._read(path, names)
                except (PatternError, OSError) as error:
                    wrong[path] = error
                    continue
                names[rule.rule] = path
                count += self._is_deployed(rule, path)
                self._seen[path] = _Seen(stamps[path], rule.rule)
            waiting = list(wrong) if len(wrong) < len(waiting) else []
        for path, reason in wrong.items():
            if path in changed:
                _say_left_out(path, reason)
            self._seen[path] = _Seen(stamps[path], None)
        return count

    def _read(self, path: Path, names: Mapping[str | None, Path]) -> Rule:
        """The file's rule.

        Raises:
            PatternError: It is none that can run.
            OSError: The file cannot be read.
        """
        rule = load_rule(path)
        if rule.rule in names:
            raise rule.error(f"the rule {rule.rule!r} is also defined in {names[rule.rule]}", "rule")
        bind(rule, readable_by(self._log, rule))
        return rule

    def _is_deployed(self, rule: Rule, path: Path) -> bool:
        for remark in doubts(self._log, [rule]):
            logger.warning("rule is doubtful", remark=remark)
        try:
            deployed = bool(deploy_all(self._log, self._station, [rule]))
        except PatternError as error:
            _say_left_out(path, error)
            return False
        if deployed:
            logger.info("rule deployed", rule=rule.rule, version=rule.version, file=str(path))
        return deployed

    def _remove(self, path: Path) -> int:
        """Retires the rule of a file that is gone for the second look; how many versions that were."""
        if path not in self._missing:
            return 0
        name = self._seen.pop(path).rule
        is_elsewhere = any(each.rule == name for each in self._seen.values())
        services = standing(self._log, self._station).values()
        if is_elsewhere or not any(each.rule == name and each.retirement is None for each in services):
            return 0
        assert name is not None, "a rule in service has a name"
        reason = f"its file {path.name} was removed"
        retired = retire(self._log, self._station, name, utc_now(), reason=reason)
        logger.info("rule retired", rule=name, reason=reason)
        return len(retired)


def _say_left_out(path: Path, error: Exception) -> None:
    logger.error("a rule file is left out; what runs goes on", file=str(path), error=str(error))
