"""Where the demo's zones and lines lie: rules are general, a scene gives them their places."""

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import as_file, files

from extractors.scene import CROSSING_LINE, LOITER_ZONE
from patterns.files.loading import load_rule
from patterns.files.rule import Rule
from patterns.scene.geometry import Line, Zone
from vian.demo.clip import Clip, Origin

RULES = ("zone-intrusion", "loitering", "line-crossing")
"""The shipped rules that the demo shows ..."""
RULES_IN_METRES = ("speeding",)
"""... and those on its square, of which it knows metres."""

Corners = Sequence[tuple[float, float]]


@dataclass(frozen=True, slots=True)
class Scene:
    """Places in one camera's picture, normalised (0 to 1, x right, y down)."""

    source: str
    zone: Corners
    """what people enter, and linger in"""
    line: Corners
    """what people cross, from its first point to its second"""
    dwell: str
    """how long is lingering"""


_LOBBY = Scene("lobby", [(0.47, 0.80), (0.72, 0.80), (0.76, 0.985), (0.43, 0.985)], [(0.85, 1.0), (0.85, 0.78)], "6 s")
_STREET = Scene("street", LOITER_ZONE, CROSSING_LINE, "6 s")
_ANY = Scene("video", [(0.25, 0.4), (0.75, 0.4), (0.85, 0.98), (0.15, 0.98)], [(0.5, 1.0), (0.5, 0.0)], "6 s")
_SQUARE = Scene("square", [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)], CROSSING_LINE, "6 s")
_SCENES: Mapping[Origin, Scene] = {
    Origin.SAMPLES: _LOBBY,
    Origin.DOWNLOAD: _LOBBY,
    Origin.RENDERED: _STREET,
    Origin.SQUARE: _SQUARE,
    Origin.GIVEN: _ANY,
}


def source_of(clip: Clip) -> str:
    """The name that the clip's camera bears in the log; one of its own for each video that a user names."""
    source = _SCENES[clip.origin].source
    if clip.origin is not Origin.GIVEN:
        return source
    with clip.path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    stem = re.sub(r"[^A-Za-z0-9._-]+", "-", clip.path.stem)[:32].strip("._-")
    return f"{stem or source}-{digest[:8]}"


def rules_for(clip: Clip) -> list[Rule]:
    """The demo's rules, with their zones and lines in the clip's scene."""
    names = RULES_IN_METRES if clip.origin is Origin.SQUARE else RULES
    return [_placed(_shipped(name), _SCENES[clip.origin], source_of(clip), clip.is_known) for name in names]


def _shipped(name: str) -> Rule:
    with as_file(files("patterns").joinpath("rules", f"{name}.yaml")) as path:
        return load_rule(path)


def _placed(rule: Rule, scene: Scene, source: str, is_known: bool) -> Rule:
    """The rule in its place: no longer what its file says, and for other scenes than the known one another rule."""
    zones = {name: Zone(source=source, polygon=tuple(scene.zone)) for name in rule.zones}
    lines = {name: Line(source=source, points=(scene.line[0], scene.line[1])) for name in rule.lines}
    params = {name: scene.dwell for name in rule.params if name == "dwell"}
    placed = rule.with_zones(zones).with_lines(lines).with_params(params).loaded_from(None, {})
    name = rule.rule if is_known else f"{rule.rule}-{source}"
    return placed.model_copy(update={"rule": name, "tests": ()})
