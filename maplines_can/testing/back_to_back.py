"""Core and model, side by side: the same frames and questions, and every bit of the answers.

`compare` runs one stream of `hostile_streams` through both. After each step it compares what they
answer, all numbers of frames, and the E2E state of the owner of the frame.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple
from importlib.util import find_spec
from itertools import count, zip_longest
from typing import Any, NamedTuple

from ..model.decoder import Receiver as Model
from ..model.decoder import View
from ..model.e2e import Windows
from ..model.records import Component
from ..model.records import Line as ModelLine
from ..model.scenes import Scene
from ..model.secoc import Keys
from ..model.sequence import SequenceCheck as ModelCheck
from ..model.settings import settings_of
from ..values.line import MapLine
from ..wire import Authenticator, Codec, Decoder, Key, Layout, Owner, Reason, SceneView
from ..wire import SlotView as LineView
from .hostile_streams import (
    PROFILES,
    SECURED_PROFILES,
    FrameStep,
    Profile,
    Question,
    Step,
    Stream,
    Traffic,
    traffics_of,
)

#: Frames of a stream: enough for states, restarts and counters that wrap around.
FRAMES = 2000
#: Secrets of the keys of streams, by key ID; of the first one from RFC 4493. Frames have its MAC.
SECRETS = {1: bytes.fromhex("2b7e151628aed2a6abf7158809cf4f3c"), 2: bytes(range(16))}
#: Time at which streams with keys begin, and the window of freshness values [us].
START_US, WINDOW_US = 1_750_000_000_000_000, 1_000_000


class Difference(NamedTuple):
    """The first difference between core and model."""

    stream: str  #: DBC, profile and seed
    step: int  #: from 0
    what: str  #: the frame or the question
    where: str  #: the value that differs
    core: str
    model: str

    def __str__(self) -> str:
        """Return the difference as text."""
        return (
            f"{self.stream}, step {self.step}, {self.what}:\n"
            f"{self.where} is {self.core} by the core, {self.model} by the model"
        )


class Result(NamedTuple):
    """Result of the comparison of a stream."""

    frames: int
    records: int  #: complete records that were checked
    difference: Difference | None


#: Whether streams can have authenticated frames: the extra ``secoc`` is installed.
HAS_MAC = find_spec("cryptography") is not None


def profiles_of(layout: Layout) -> list[Profile]:
    """Return the profiles of streams that a DBC can have."""
    secured = SECURED_PROFILES if layout.secured is not None and HAS_MAC else ()
    return [profile for profile in (*PROFILES, *secured) if _is_possible(profile, layout)]


def _is_possible(profile: Profile, layout: Layout) -> bool:
    """Return whether a receiver of a DBC can have the settings of a profile."""
    try:
        Pair(layout, profile)
    except ValueError:  # the counter, or the freshness value, is too short
        return False
    return True


def compare(traffics: Sequence[Traffic], profile: Profile, frames: int, seed: int) -> Result:
    """Compare core and model on a stream of so many frames, up to the first difference."""
    layout = traffics[0].layout
    pair = Pair(layout, profile)
    sign = pair.sign if profile.is_signed else None
    stream = Stream(traffics, profile, seed, sign, START_US)
    name = f"{layout.source}, {profile.name}, seed {seed}"
    for number, step in enumerate(stream.steps()):
        found = next(pair.differences(step), None)
        if found is not None:
            difference = Difference(name, number, _text(step), *found)
            return Result(pair.model.frames, pair.records, difference)
        if pair.model.frames >= frames:
            break
    return Result(pair.model.frames, pair.records, None)


class StreamComparison(NamedTuple):
    """Result of the comparison of a kind of streams."""

    equal: int  #: number of answers that were equal
    what: str  #: they are, in words
    difference: Difference | None = None  #: the first one, which ended it

    def __str__(self) -> str:
        """Return the result as text."""
        if self.difference is not None:
            return f"core and model differ: {self.difference}"
        return f"bit-identical on {self.equal} {self.what}"


class Comparison(NamedTuple):
    """Result of the comparison of many streams."""

    frames: int
    records: int
    streams: int
    difference: Difference | None  #: the first one, which ended it

    def __str__(self) -> str:
        """Return the result as text."""
        if self.difference is not None:
            return f"core and model differ: {self.difference}"
        return (
            f"bit-identical on {self.records} records "
            f"({self.frames} frames in {self.streams} streams)"
        )


def compare_all(
    layouts: Sequence[Layout],
    seed: int,
    is_over: Callable[[], bool],
    frames: int = FRAMES,
) -> Comparison:
    """Compare core and model on streams of all profiles of some DBCs, until it is over.

    The streams of a seed are always the same ones, in the same order: one of each profile and DBC,
    then others. At least one is compared.

    Args:
        layouts: of the DBCs.
        seed: of all streams.
        is_over: asked after each stream.
        frames: of a stream.
    """
    total = Comparison(0, 0, 0, None)
    for turn in count():
        traffics = [traffics_of(layout, seed + turn) for layout in layouts]
        kinds = [[(own, one) for one in profiles_of(own[0].layout)] for own in traffics]
        mixed = (pair for pairs in zip_longest(*kinds) for pair in pairs if pair is not None)
        for own, profile in mixed:
            of_stream = 1000 * (seed + turn) + total.streams
            result = compare(own, profile, frames, of_stream)
            total = Comparison(
                total.frames + result.frames,
                total.records + result.records,
                total.streams + 1,
                result.difference,
            )
            if result.difference is not None or is_over():
                return total
    raise AssertionError  # count has no end


class CoreSide:
    """A decoder of the core that takes steps of a stream.

    Args:
        layout: of the DBC.
        profile: has the settings.
    """

    def __init__(self, layout: Layout, profile: Profile) -> None:
        self.now_us = START_US  #: time of the clock of freshness values
        self._layout, self._stale_cycles = layout, profile.stale_cycles
        self._decoder = self._codec(profile).decoder(**profile.settings)
        self._decoder._settings.refuses_short_spacings = profile.refuses  # noqa: SLF001
        self._checks = self._decoder.checks
        self._owners_of = _owners_of(layout)

    def take(self, step: Step) -> dict[str, Any]:
        """Take a step; return the answers as plain values."""
        return {
            "the answer": self._answer(step),
            "the receiver": _numbers(self._decoder),
            **{f"the check of {o!r}": _check(self._checks[o]) for o in self._owners_of(step)},
        }

    def _codec(self, profile: Profile) -> Codec:
        if not profile.has_keys:
            return Codec(self._layout)
        clock = (lambda: 1000 * self.now_us) if profile.has_clock else None
        keys = _keys().values()
        return Codec(self._layout, Authenticator(*keys, clock=clock, window_ns=1000 * WINDOW_US))

    def _answer(self, step: Step) -> Any:
        core = self._decoder
        if isinstance(step, FrameStep):
            self.now_us = step.now_us
            is_extended = step.is_extended
            return _answer(core.feed(step.can_id, step.data, step.t_ns, is_extended=is_extended))
        if step.kind == "latest":
            return _view(core.latest(step.slot, step.t_ns, stale_cycles=self._stale_cycles))
        if step.kind == "scene" and self._layout.pose is not None:
            return _view(core.latest_scene(step.t_ns, stale_cycles=self._stale_cycles))
        if step.kind == "expire":
            core.expire(step.t_ns)
        elif step.kind == "statistics":
            core.messages(step.t_ns)
        return None


class ModelSide:
    """The receiver of the model that takes the same steps; with the same arguments."""

    def __init__(self, layout: Layout, profile: Profile) -> None:
        self.now_us = START_US
        self.answer: Any = None  #: last answer, as the model gives it
        self._layout, self._stale_cycles = layout, profile.stale_cycles
        settings = dict(profile.settings)
        e2e = settings.pop("e2e", None)
        windows = None if e2e is None else Windows(*astuple(e2e))
        self.receiver = Model(
            layout,
            settings_of(layout, windows=windows, **settings),
            self._keys(profile),
            refuses_short_spacings=profile.refuses,
        )
        self._checks = self.receiver.checks
        self._owners_of = _owners_of(layout)

    @property
    def records(self) -> int:
        """Complete records that were checked."""
        checks = self._checks.values()
        return sum(check.statuses.total() - check.statuses["NONEWDATA"] for check in checks)

    def take(self, step: Step) -> dict[str, Any]:
        """Take a step; return the answers as plain values."""
        return {
            "the answer": self._answer(step),
            "the receiver": _model_numbers(self.receiver),
            **{f"the check of {o!r}": _model_check(self._checks[o]) for o in self._owners_of(step)},
        }

    def _keys(self, profile: Profile) -> Keys | None:
        if not profile.has_keys:
            return None
        clock_us = (lambda: self.now_us) if profile.has_clock else None
        keys = _keys()

        def mac(key_id: int, data: bytes) -> bytes | None:
            return keys[key_id].mac(data) if key_id in keys else None

        return Keys(mac, clock_us, WINDOW_US)

    def _answer(self, step: Step) -> Any:
        model = self.receiver
        if isinstance(step, FrameStep):
            self.now_us = step.now_us
            is_extended = step.is_extended
            answer = model.feed(step.can_id, step.data, step.t_ns, is_extended=is_extended)
            self.answer = answer
            return _model_answer(answer)
        if step.kind == "latest":
            self.answer = model.latest(step.slot, step.t_ns, self._stale_cycles)
            return _model_view(self.answer)
        if step.kind == "scene" and self._layout.pose is not None:
            self.answer = model.latest_scene(step.t_ns, self._stale_cycles)
            return _model_view(self.answer)
        if step.kind == "expire":
            model.expire(step.t_ns)
        elif step.kind == "statistics":
            model.elapse(step.t_ns)
        return None


class Pair:
    """A decoder of the core, and the receiver of the model with the same settings.

    Args:
        layout: of the DBC.
        profile: has the settings.
    """

    def __init__(self, layout: Layout, profile: Profile) -> None:
        self.profile = profile
        self.core_side, self.model_side = CoreSide(layout, profile), ModelSide(layout, profile)
        self._layout = layout
        self._signing_key = _keys()[1] if profile.is_signed else None

    @property
    def model(self) -> Model:
        """The receiver of the model."""
        return self.model_side.receiver

    @property
    def answer(self) -> Any:
        """The last answer of the model."""
        return self.model_side.answer

    @property
    def now_us(self) -> int:
        """Time of the clock of freshness values."""
        return self.model_side.now_us

    @property
    def records(self) -> int:
        """Complete records that were checked."""
        return self.model_side.records

    def sign(self, owner: Owner, record: bytes, now_us: int) -> bytes:
        """Return the authenticated payload of a record."""
        messages = self._layout.messages_of[owner]
        layout = self._layout.record_of(owner)
        assert layout.secured is not None  # noqa: S101 - a stream has records of what the DBC has
        assert self._signing_key is not None  # noqa: S101 - likewise
        authenticator = Authenticator(self._signing_key, clock=lambda: 1000 * now_us)
        return authenticator.secure(record, messages.secured_data_id, layout.secured)

    def differences(self, step: Step) -> Iterator[tuple[str, str, str]]:
        """Take a step; yield what differs: where, and the values."""
        core, model = self.core_side.take(step), self.model_side.take(step)
        for where, answer in core.items():
            yield from _differences(where, answer, model[where])


def _keys() -> dict[int, Key]:
    """Return the keys of streams, by their IDs."""
    return {key_id: Key(secret, key_id) for key_id, secret in SECRETS.items()}


def _owners_of(layout: Layout) -> Callable[[Step], list[Owner]]:
    """Return a function of those whose checks a step may change: of a question, any."""
    owner_of = {key: owner for key, (owner, _) in layout.message_of_id.items()}
    everyone = [*layout.messages_of]

    def owners(step: Step) -> list[Owner]:
        if isinstance(step, Question):
            return everyone
        key = step.can_id, step.is_extended
        return [owner_of[key]] if key in owner_of else []

    return owners


def _differences(where: str, core: Any, model: Any) -> Iterator[tuple[str, str, str]]:
    """Yield the values that differ, in lists and dictionaries of any depth; floats by bits."""
    if isinstance(core, dict) and isinstance(model, dict):
        for name in core.keys() | model.keys():
            yield from _differences(f"{where}: {name}", core.get(name), model.get(name))
    elif isinstance(core, list) and isinstance(model, list) and len(core) == len(model):
        for i, (one, other) in enumerate(zip(core, model, strict=True)):
            yield from _differences(f"{where}[{i}]", one, other)
    elif _bits(core) != _bits(model):
        yield where, _shown(core), _shown(model)


def _bits(value: Any) -> Any:
    return struct.pack("<d", value) if isinstance(value, float) else value


def _shown(value: Any) -> str:
    return f"{value!r} ({value.hex()})" if isinstance(value, float) else repr(value)


def _text(step: Step) -> str:
    if isinstance(step, Question):
        return f"{step.kind} of {step.slot.name} at {step.t_ns} ns"
    return f"frame {step.can_id:X}#{step.data.hex().upper()} at {step.t_ns} ns"


# ---- answers as plain values ----------------------------------------------------------------


def _answer(answer: Any) -> Any:
    return answer.name if isinstance(answer, Reason) else [_line(line) for line in answer]


def _model_answer(answer: list[ModelLine] | str) -> Any:
    return answer if isinstance(answer, str) else [_model_line(line) for line in answer]


def _line(line: MapLine | None) -> Any:
    if line is None:
        return None
    mixture = line.mixture
    components = () if mixture is None else zip(mixture.weights, mixture.components, strict=True)
    return _named(
        *(line.slot, line.kind, line.status, line.x_min, line.x_max, line.age, line.t_ns),
        line.gaussian.mean.tolist(),
        line.gaussian.cov.tolist(),
        [[float(w), one.mean.tolist(), one.cov.tolist()] for w, one in components],
    )


def _model_line(line: ModelLine | None) -> Any:
    if line is None:
        return None
    return _named(
        *(line.slot, line.kind, line.status, line.x_min, line.x_max, line.age, line.t_ns),
        line.mean,
        line.cov,
        [_component(component) for component in line.components],
    )


def _component(component: Component) -> Any:
    return [component.weight, component.line.mean, component.line.cov]


def _named(*values: Any) -> dict[str, Any]:
    names = ("slot", "kind", "status", "x_min", "x_max", "age", "t_ns", "mean", "cov", "components")
    numbers = (float(value) if i in (3, 4, 5) else value for i, value in enumerate(values))
    return dict(zip(names, numbers, strict=True))


def _view(view: LineView | SceneView) -> dict[str, Any]:
    found: dict[str, Any] = {
        "age": float(view.age),
        "stale": bool(view.stale),
        "state": view.state.name,
        "status": None if view.status is None else view.status.name,
        "two senders": bool(view.two_senders),
        "usable": bool(view.usable),
    }
    if not isinstance(view, SceneView):
        left_out = None if view.left_out is None else view.left_out.name
        return found | {"line": _line(view.line), "left out": left_out, "states": {}}
    found["states"] = {slot.name: state.name for slot, state in view.slot_states.items()}
    scene = view.scene
    if scene is None or view.received is None:
        return found | {"line": None, "left out": None}
    error = scene.map_error
    return found | {
        "counter": view.received.counter,
        "t_ns": view.received.t_ns,
        "lines": [_line(line) for line in scene.lines],
        "cov": scene.cov.tolist(),
        "pose": scene.pose_error.cov.tolist(),
        "correlation time": float(scene.pose_error.correlation_time),
        "map error": None if error is None else [error.offset_sigma, error.heading_sigma],
        "fit ranges": scene.fit_ranges.tolist(),
        "quartics": scene.quartics.tolist(),
        "specific": [] if scene.specific_covs is None else scene.specific_covs.tolist(),
        "left out": {slot.name: why.name for slot, why in scene.left_out.items()},
    }


def _model_view(view: View) -> dict[str, Any]:
    found: dict[str, Any] = {
        "age": view.age,
        "stale": view.is_stale,
        "state": view.state,
        "status": view.status,
        "states": {slot.name: state for slot, state in view.slot_states.items()},
        "two senders": view.may_be_two,
        "usable": view.is_usable,
    }
    scene = view.content
    if not isinstance(scene, Scene):
        return found | {"line": _model_line(scene), "left out": view.left_out}
    pose = scene.pose
    return found | {
        "counter": pose.counter,
        "t_ns": pose.t_ns,
        "lines": [_model_line(line) for line in scene.lines],
        "cov": scene.cov,
        "pose": pose.cov,
        "correlation time": pose.correlation_time,
        "map error": [pose.offset_sigma, pose.heading_sigma],
        "fit ranges": [[*ends] for ends in scene.fit_ranges],
        "quartics": scene.quartics,
        "specific": scene.own,
        "left out": {slot.name: why for slot, why in scene.left_out.items()},
    }


def _numbers(decoder: Decoder) -> dict[str, Any]:
    return _counted(decoder, {reason.name: n for reason, n in decoder.counts.items()})


def _model_numbers(model: Model) -> dict[str, Any]:
    return _counted(model, model.counts)


def _counted(receiver: Decoder | Model, counts: Any) -> dict[str, Any]:
    names = (
        "frames", "lines", "line_frames", "pose_errors", "pose_frames", "pending", "short_spacings",
    )  # fmt: skip
    found: dict[str, Any] = {name: getattr(receiver, name) for name in names}
    return found | {"counts": {reason: n for reason, n in counts.items() if n}}


def _check(check: Any) -> dict[str, Any]:
    return {
        "state": check.state.name,
        "status": None if check.status is None else check.status.name,
        "lost": check.lost,
        "ahead": check.ahead,
        "counter": check.counter,
        "two senders": check.two_senders,
        "statuses": {status.name: n for status, n in check.statuses.items() if n},
    }


def _model_check(check: ModelCheck) -> dict[str, Any]:
    return {
        "state": check.state,
        "status": check.status,
        "lost": check.lost,
        "ahead": check.ahead,
        "counter": check.last,
        "two senders": check.senders.are_two,
        "statuses": {status: n for status, n in check.statuses.items() if n},
    }
