"""Traps in the signals: outliers, saturation, zeros and preloads, holds, force control, oscillation, rupture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.raw_files.drafts import Column, Draft
from benchmarks.raw_files.trap import ALL, OnDraft, OnTest, Trap, change_columns
from benchmarks.raw_files.truth import COMPRESSION, TENSION, Test, fitted_modulus, relaxing_force

#: Layouts whose displacement counts from a zero of the test: the static displacement of an oscillation is in the file.
_ZEROED = tuple(name for name in ALL if name not in ("mach1", "trios"))
#: Aspect: history of the loading.
_HISTORY = frozenset({"history"})
#: Aspect: defect of samples.
_DEFECT = frozenset({"defect"})
#: Aspect: saturation.
_CLIP = frozenset({"clip"})
_DEFORMED = (COMPRESSION, TENSION)
_OUTLIER = ("outlier", "spike", "neighbour", "left out", "single sample", "first sample", "last sample", "jump")
_LEFT_OUT = "outlier|spike|left out"
_RELAX = ("relax", "viscoelastic", "(in|during) (the |its )?holds?", "creep", "time-dependent")
_PRELOAD = ("preload", "contact", "offset", "zeroed", "zero of", "tare")


def _spike(role: str, place: str, size: str) -> OnDraft:
    """Replace one value by an outlier.

    Args:
        role: of the column. place: ``first``, ``last`` or ``inner``. size: ``up``, ``down``, ``zero``, ``9999`` or
            ``several`` (two or three samples).
    """
    def apply(draft: Draft, rng: np.random.Generator) -> None:
        for table in draft.tables:
            column = table.column(role)
            if column is None:
                continue
            values, last = column.values.copy(), column.values.size - 1
            count = int(rng.integers(2, 4)) if size == "several" else 1
            places = {"first": np.array([0]), "last": np.array([last])}.get(
                place, rng.choice(np.arange(4, last - 3, 4), count, replace=False))
            reach = np.ptp(values)
            for index in places:
                values[index] = {"zero": 0.0, "9999": 9999.0}.get(
                    size, values[index] + (1 if size == "up" or rng.random() < 0.5 else -1)
                    * float(rng.uniform(0.3, 3.0)) * reach)
                if size == "down":
                    values[index] = column.values[index] - float(rng.uniform(0.3, 3.0)) * reach
            table.columns = [replace(each, values=values) if each is column else each for each in table.columns]
    return apply


def _saturate(draft: Draft, rng: np.random.Generator) -> None:
    """Saturate the load cell at a fraction of the largest force."""
    share = float(rng.uniform(0.5, 0.9))

    def change(column: Column) -> Column:
        if column.role not in ("force", "stress"):
            return column
        limit = share * np.abs(column.values).max()
        return replace(column, values=np.clip(column.values, -limit, limit))

    change_columns(draft, change)


def _coarse(draft: Draft, rng: np.random.Generator) -> None:
    """Round the force to steps of 1/30 to 1/15 of its range."""
    levels = float(rng.uniform(15, 30))

    def change(column: Column) -> Column:
        step = np.abs(column.values).max() / levels
        return replace(column, values=np.round(column.values / step) * step) if column.role == "force" else column

    change_columns(draft, change)


def _ramp(test: Test, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Return times (s) and displacements (m) of one loading to the depth of the test in 5 to 20 s."""
    depth = float(test.motion.max())
    return np.linspace(0.0, max(min(depth / 0.5e-3, 20.0), 5.0), points), np.linspace(0.0, depth, points)


def _air(test: Test, rng: np.random.Generator) -> Test:
    """Add a motion without force before contact, or a slack strip."""
    time, motion = _ramp(test, 100)
    gap = float(rng.uniform(0.1, 0.5)) * motion[-1]
    count = max(round(gap / motion[1]), 5)
    gap = count * motion[1]
    before = np.arange(-count, 0) * motion[1]
    moved = test.with_motion(np.concatenate([time[1] * np.arange(count), time + count * time[1]]),
                             np.concatenate([before, motion]))
    return replace(moved, motion=moved.motion + gap)


def _preload(test: Test, rng: np.random.Generator) -> Test:
    """Zero the displacement some distance after contact, but not the force."""
    time, motion = _ramp(test, 90)
    start = int(rng.integers(6, 25))
    pressed = test.with_motion(time[:90 - start], motion[start:])
    return replace(pressed, motion=pressed.motion - motion[start])


def _force_offset(test: Test, rng: np.random.Generator) -> Test:
    """Add the offset of a load cell that was not zeroed."""
    test = test.with_motion(*_ramp(test, 90))
    sign = float(rng.choice((-1.0, 1.0)))
    return replace(test, force=test.force + sign * float(rng.uniform(0.03, 0.2)) * test.force.max())


def _relaxing(time: np.ndarray, motion: np.ndarray, test: Test, loaded: int, rng: np.random.Generator
              ) -> tuple[Test, tuple[float, ...]]:
    """Return the test on a solid that relaxes by 15 to 50 %, with instantaneous, relaxed and fitted moduli."""
    fraction, tau = float(rng.uniform(0.15, 0.5)), float(rng.uniform(2.0, 20.0))
    moved = test.with_motion(time, motion)
    moved = replace(moved, force=relaxing_force(time, moved.force, fraction, tau))
    return moved, (test.mu, test.mu * (1 - fraction), fitted_modulus(moved, 0, loaded))


def _ramp_and_hold(test: Test, rng: np.random.Generator) -> tuple[Test, tuple[float, ...]]:
    depth, loading = float(test.motion.max()), float(rng.uniform(1.0, 4.0))
    time = np.arange(0.0, loading + float(rng.uniform(20, 80)), loading / 25)
    return _relaxing(time, np.minimum(depth * time / loading, depth), test, 26, rng)


def _relaxing_stairs(test: Test, rng: np.random.Generator) -> tuple[Test, tuple[float, ...]]:
    steps, loading, hold = int(rng.integers(3, 6)), 3.0, float(rng.uniform(15, 40))
    time = np.arange(0.0, steps * (loading + hold), 0.5)
    number, within = np.divmod(time, loading + hold)
    motion = float(test.motion.max()) / steps * (number + np.minimum(within / loading, 1.0))
    return _relaxing(time, motion, test, 7, rng)


def _elastic_stairs(test: Test, rng: np.random.Generator) -> Test:
    steps, loading, hold = int(rng.integers(3, 7)), 2.0, float(rng.uniform(4, 15))
    time = np.arange(0.0, steps * (loading + hold), 0.4)
    number, within = np.divmod(time, loading + hold)
    return test.with_motion(time, float(test.motion.max()) / steps * (number + np.minimum(within / loading, 1.0)))


def _pauses(test: Test, rng: np.random.Generator) -> Test:
    """Return an elastic ramp with two stops."""
    _, motion = _ramp(test, 80)
    counts = np.ones(80, int)
    counts[rng.choice(np.arange(20, 70), 2, replace=False)] = int(rng.integers(8, 25))
    motion = np.repeat(motion, counts)
    return test.with_motion(0.1 * np.arange(motion.size), motion)


def _creep(test: Test, rng: np.random.Generator) -> tuple[Test, tuple[float, ...]]:
    """Return a test at constant force; the compliance is 1 + c (1 - exp(-t / tau))."""
    creep, tau = float(rng.uniform(0.2, 0.6)), float(rng.uniform(5, 30))
    loading = float(rng.choice((1.0, 3.0)))
    time = np.arange(0.0, 5 * tau, tau / 30)
    force = test.elastic_force(np.array([0.6 * test.motion.max()]))[0] * np.minimum(time / loading, 1.0)
    compliance = 1 + creep * (1 - np.exp(-np.maximum(time - loading / 2, 0) / tau))
    motion = np.array([replace(test, mu=test.mu / each).motion_at(np.array([pull]))[0]
                       for each, pull in zip(compliance, force, strict=True)])
    return replace(test, time=time, motion=motion, force=force), (test.mu, test.mu / (1 + creep))


def _force_ramp(test: Test, rng: np.random.Generator) -> Test:
    """Return an elastic test whose force grows linearly in time."""
    force = np.linspace(0.0, float(test.force.max()), int(rng.integers(60, 120)))
    return test.with_force(0.1 * np.arange(force.size), force)


def _force_stairs(test: Test, rng: np.random.Generator) -> tuple[Test, tuple[float, ...]]:
    """Return a test with weights added one by one; the displacement creeps under each."""
    steps, hold, tau, creep = int(rng.integers(3, 6)), 20.0, float(rng.uniform(3, 8)), float(rng.uniform(0.15, 0.5))
    time = np.arange(0.0, steps * hold, 0.5)
    number = np.floor(time / hold)
    force = float(test.force.max()) * 0.7 / steps * (number + 1)
    force[0] = 0.0
    # Each weight creeps by itself; the lags add up as in a linear solid.
    lag = sum((1 - np.exp(-np.maximum(time - k * hold, 0) / tau)) * (time >= k * hold) for k in range(steps))
    compliance = 1 + creep * lag / (number + 1)
    motion = np.array([replace(test, mu=test.mu / each).motion_at(np.array([pull]))[0]
                       for each, pull in zip(compliance, force, strict=True)])
    return replace(test, time=time, motion=motion, force=force), (test.mu, test.mu / (1 + creep))


def _oscillation(start: str, loss: float) -> OnTest:
    """Return a sine about a static displacement, with or without a ramp before; `loss` is E'' over E'."""
    def apply(test: Test, rng: np.random.Generator) -> tuple[Test, tuple[float, ...]]:
        static = 0.6 * float(test.motion.max())
        amplitude = static * float(rng.uniform(0.1, 0.3))
        time = np.arange(0.0, 6.0, 0.04)
        motion = static + amplitude * np.sin(2 * np.pi * time)
        moved = test.with_motion(time, motion)
        if loss:
            speed = 2 * np.pi * amplitude * np.cos(2 * np.pi * time)
            slope = (test.elastic_force(motion + 1e-6) - test.elastic_force(motion - 1e-6)) / 2e-6
            moved = replace(moved, force=moved.force + loss * slope * speed / (2 * np.pi))
        if start == "ramp":
            before = np.linspace(0.0, static, 60, endpoint=False)
            moved = replace(moved, time=np.concatenate([0.1 * np.arange(60), 6.0 + time]),
                            motion=np.concatenate([before, moved.motion]),
                            force=np.concatenate([test.elastic_force(before), moved.force]))
        # A fit may report the storage modulus or the magnitude of the complex modulus, a third of each.
        return moved, (test.mu, test.mu * float(np.hypot(1.0, loss)))
    return apply


def _rupture(test: Test, rng: np.random.Generator) -> Test:
    """Return a test in which the specimen tears after 60 to 90 % of the motion."""
    test = test.with_motion(*_ramp(test, 120))
    end = int(float(rng.uniform(0.6, 0.9)) * 120)
    force = test.force.copy()
    force[end:] *= 0.03 * np.exp(-np.arange(120 - end) / 5.0)
    return replace(test, force=force)


def _trap(name: str, on_test: OnTest, reasons: tuple[str, ...], *, wants_right: bool = True, note: str = "",
          groups: frozenset[str] = _HISTORY, layouts: tuple[str, ...] = ALL) -> Trap:
    return Trap(name, "signals", groups, reasons, wants_right, note, on_test=on_test, kinds=_DEFORMED, layouts=layouts)


def _spikes() -> tuple[Trap, ...]:
    made: list[Trap] = []
    ends = ("up", "down", "9999")
    sizes = {"first": ends, "last": ends, "inner": (*ends, "zero", "several")}
    for role in ("force", "displacement"):
        for place in sizes:
            made += [Trap(f"{place} {role} {size}", "signals", _DEFECT, (*_OUTLIER, "9999"), note=_LEFT_OUT,
                          on_draft=_spike(role, place, size)) for size in sizes[place]]
    return tuple(made)


_ANY = ("oscillat", "sinus", "sine", "dynamic", "harmonic")
SIGNAL_TRAPS = (
    *_spikes(),
    Trap("saturated force", "signals", _CLIP, ("saturat", "stays at", "clipped"), note="saturat|stays at",
         on_draft=_saturate),
    Trap("coarse force", "signals", _CLIP, ("resolution", "digit"), on_draft=_coarse),
    _trap("air before contact", _air, ("contact", r"\bair\b", "slack"), groups=_HISTORY | {"air"}),
    _trap("displacement zeroed at a preload", _preload, _PRELOAD),
    _trap("force not zeroed", _force_offset, _PRELOAD),
    _trap("ramp and hold, relaxing", _ramp_and_hold, _RELAX, note="relax|viscoelastic"),
    _trap("stairs, relaxing", _relaxing_stairs, _RELAX, wants_right=False, note="relax|viscoelastic"),
    _trap("stairs, elastic", _elastic_stairs, _RELAX),
    _trap("pauses", _pauses, _RELAX),
    _trap("creep", _creep, (*_RELAX, "force is held", "constant force"), wants_right=False,
          note="relax|creep|viscoelastic|constant force|force is held"),
    _trap("force ramp", _force_ramp, ("force is (held|prescribed|controlled)", "load.controlled")),
    _trap("stairs of force, creeping", _force_stairs, (*_RELAX, "force is held", "constant force"), wants_right=False,
          note="relax|creep|viscoelastic|constant force|force is held"),
    _trap("sine about a static displacement", _oscillation("at once", 0.0), _ANY, groups=_HISTORY | {"air", "zero"},
          layouts=_ZEROED),
    _trap("ramp, then a sine", _oscillation("ramp", 0.0), _ANY),
    _trap("sine with loss", _oscillation("at once", 0.25), (*_ANY, "loss", "phase", "viscoelastic"), wants_right=False,
          groups=_HISTORY | {"air", "zero"}, layouts=_ZEROED),
    _trap("ramp, then a sine with loss", _oscillation("ramp", 0.25), (*_ANY, "loss", "phase", "viscoelastic"),
          wants_right=False),
    _trap("rupture", _rupture, ("rupture", r"\btears?\b", "breaks?", "fails? at", "torn"), note="rupture|fail|tear"),
)
