"""A body's pose over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch

from scenes.checks import check_tensor
from scenes.poses import as_pose, interpolate, translation

_SECONDS = "seconds times 1e6, rounded"


def whole_times(times_us) -> torch.Tensor:
    """Times as int64 `[T]` of whatever torch reads. ValueError where one is no whole number of microseconds."""
    times = torch.as_tensor(times_us)
    if not times.is_floating_point():
        return times.to(torch.int64)
    times = torch.as_tensor(times_us, dtype=torch.float64)  # of Python's floats, float32 would be too coarse
    broken = times != times.round()  # nan is, too
    if broken.any():
        raise ValueError(f"times_us must be whole microseconds, got {float(times[broken][0])}; {_SECONDS}")
    return times.to(torch.int64)


@dataclass(frozen=True)
class Trajectory:
    """Poses of a body: `times_us` int64 `[T]`, rising strictly; `world_from_body` float64 `[T, 4, 4]`; T >= 1.

    One pose stands still and covers all times. Otherwise the trajectory covers its time span and half a step beyond
    either end, extrapolated, since a camera's clock rarely agrees with the annotations' to the microsecond.
    """

    times_us: torch.Tensor
    world_from_body: torch.Tensor

    def __post_init__(self):
        object.__setattr__(self, "times_us", whole_times(self.times_us))
        object.__setattr__(self, "world_from_body", as_pose(self.world_from_body))
        check_tensor("times_us", self.times_us, ("T",), torch.int64)
        t = self.times_us.shape[0]
        if t == 0:
            raise ValueError("a trajectory must have at least one pose, got none")
        check_tensor("world_from_body", self.world_from_body, (t, 4, 4), torch.float64)
        if t > 1 and not (self.times_us.diff() > 0).all():
            raise ValueError(f"times_us must rise strictly, but entry {int((self.times_us.diff() <= 0).nonzero()[0]) + 1} does not")

    def __len__(self) -> int:
        return self.times_us.shape[0]

    def span_us(self) -> tuple[int, int]:
        """First and last covered time, half a step beyond the poses; int64's ends where the body stands still."""
        return self._span_us

    @cached_property
    def _span_us(self) -> tuple[int, int]:  # every actor of a scene is asked whether it is there, in each frame
        if len(self) == 1:
            return -(2**63), 2**63 - 1
        t = self.times_us
        return int(t[0] - (t[1] - t[0]) // 2), int(t[-1] + (t[-1] - t[-2]) // 2)

    def covers(self, time_us: int) -> bool:
        first, last = self.span_us()
        return first <= int(time_us) <= last

    def covers_each(self, times_us: torch.Tensor) -> torch.Tensor:
        """Which of times int64 `[n]` are covered, bool `[n]`."""
        first, last = self.span_us()
        return (first <= times_us) & (times_us <= last)

    def at(self, time_us: int) -> torch.Tensor:
        """`world_from_body` `[4, 4]` at a time: slerp and lerp between neighbours. ValueError where not covered."""
        if int(time_us) != time_us:
            raise ValueError(f"a time must be whole microseconds, got {time_us}; {_SECONDS}")
        if not self.covers(time_us):
            first, last = self.span_us()
            raise ValueError(f"time {int(time_us)} us is outside the trajectory, which covers {first} to {last} us")
        if len(self) == 1:
            return self.world_from_body[0]
        return interpolate(*self._around(int(time_us)))

    def _around(self, time_us: int) -> tuple[torch.Tensor, torch.Tensor, float]:
        """The poses before and after a time, and its share of the way; of the nearest step where it lies beyond an end."""
        later = int(torch.searchsorted(self.times_us, time_us).clamp(1, len(self) - 1))
        t0, t1 = self.times_us[later - 1 : later + 1].tolist()
        return self.world_from_body[later - 1], self.world_from_body[later], (time_us - t0) / (t1 - t0)

    def at_each(self, times_us: torch.Tensor) -> torch.Tensor:
        """`world_from_body` `[n, 4, 4]` at times int64 `[n]`, as `at` gives them one by one. ValueError where one is not covered."""
        if len(times_us) and not (self.covers(int(times_us.min())) and self.covers(int(times_us.max()))):
            return torch.stack([self.at(int(t)) for t in times_us])  # which names the one
        if len(self) == 1:
            return self.world_from_body.expand(len(times_us), 4, 4)
        later = torch.searchsorted(self.times_us, times_us.contiguous()).clamp(1, len(self) - 1)
        before, after = self.times_us[later - 1], self.times_us[later]
        share = (times_us - before).double() / (after - before)
        return interpolate(self.world_from_body[later - 1], self.world_from_body[later], share)

    def near(self, time_us: int) -> torch.Tensor:
        """`world_from_body` `[4, 4]` at a time, or at the nearest that is covered: where a readout ends after the path does."""
        first, last = self.span_us()
        return self.at(min(max(int(time_us), first), last))

    def near_each(self, times_us: torch.Tensor) -> torch.Tensor:
        """`world_from_body` `[n, 4, 4]` at times int64 `[n]`, or at the nearest that are covered, as `near` gives them one by one."""
        return self.at_each(times_us.clamp(*self.span_us()))

    def within(self, span_us: tuple[int, int]) -> Trajectory:
        """The poses of a span of time, with the last one before it and the first after it."""
        first = int(torch.searchsorted(self.times_us, int(span_us[0]), right=True)) - 1
        last = int(torch.searchsorted(self.times_us, int(span_us[1])))
        part = slice(min(max(first, 0), len(self) - 1), max(last, 0) + 1)
        return Trajectory(self.times_us[part], self.world_from_body[part])

    def shifted(self, lateral: float = 0.0, vertical: float = 0.0, forward: float = 0.0) -> Trajectory:
        """Every pose moved by metres along its own body axes: forward x, left y, up z."""
        return replace(self, world_from_body=self.world_from_body @ translation(forward, lateral, vertical))


def all_at(trajectories: Sequence[Trajectory], time_us: int) -> list[torch.Tensor]:
    """Each trajectory's pose `[4, 4]` at a time that all cover, as `at` gives them one by one, interpolated together."""
    return _together(trajectories, [int(time_us)] * len(trajectories))


def all_near(trajectories: Sequence[Trajectory], time_us: int) -> list[torch.Tensor]:
    """Each trajectory's pose `[4, 4]` at a time, or at the nearest that it covers, as `near` gives them one by one."""
    spans = [t.span_us() for t in trajectories]
    return _together(trajectories, [min(max(int(time_us), first), last) for first, last in spans])


def _together(trajectories: Sequence[Trajectory], times_us: Sequence[int]) -> list[torch.Tensor]:
    poses = [t.world_from_body[0] for t in trajectories]
    moving = [i for i, t in enumerate(trajectories) if len(t) > 1]
    if moving:
        before, after, share = zip(*(trajectories[i]._around(times_us[i]) for i in moving), strict=True)
        for i, pose in zip(
            moving, interpolate(torch.stack(before), torch.stack(after), torch.tensor(share, dtype=torch.float64)), strict=True
        ):
            poses[i] = pose
    return poses


def between(times_us: torch.Tensor, values: torch.Tensor, time_us: int) -> torch.Tensor:
    """Values `[T, ...]` at a time: linear between `times_us` `[T]`, held beyond."""
    if len(times_us) == 1:
        return values[0]
    later = int(torch.searchsorted(times_us, int(time_us)).clamp(1, len(times_us) - 1))
    first, last = times_us[later - 1 : later + 1].tolist()
    share = min(max((int(time_us) - first) / max(last - first, 1), 0.0), 1.0)
    return values[later - 1] * (1 - share) + values[later] * share
