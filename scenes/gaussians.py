"""Gaussian splats, splats placed in the world, and the model they were trained with."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from numbers import Integral

import torch

from scenes.checks import check_tensor
from scenes.deformation import Lattice
from scenes.poses import as_pose

SH_COUNTS = (1, 4, 9, 16)
PROJECTIONS = ("ut", "ewa")
RESPONSES = ("conic", "ray")

AVERAGED = 0.1
"""Variance in px^2 of a Gaussian that averages as a pixel does."""


@dataclass(frozen=True)
class SplatModel:
    """How the splats turn into pixels: stored with them, since trained splats fit only the model that trained them.

    projection: "ut" (unscented transform) or "ewa" (Zwicker et al. 2001); response: "conic" (2D) or "ray" (3D, 3DGUT);
    dilation: px^2 added to both 2D variances; antialias: opacity compensated for that dilation (Mip-Splatting's 2D filter); smoothing: px^2
    added besides, opacity compensated for these, as for pictures smaller than those that were trained on (`at_scale`).
    """

    projection: str = "ut"
    response: str = "conic"
    dilation: float = 0.3
    antialias: bool = False
    smoothing: float = 0.0

    def __post_init__(self):
        if self.projection not in PROJECTIONS:
            raise ValueError(f"projection must be one of {', '.join(PROJECTIONS)}, got {self.projection!r}")
        if self.response not in RESPONSES:
            raise ValueError(f"response must be one of {', '.join(RESPONSES)}, got {self.response!r}")
        if not 0 <= self.dilation < math.inf:
            raise ValueError(f"dilation must be at least 0 px^2 and finite, got {self.dilation}")
        if not 0 <= self.smoothing < math.inf:
            raise ValueError(f"smoothing must be at least 0 px^2 and finite, got {self.smoothing}")

    @property
    def widening(self) -> float:
        """px^2 added to both 2D variances in all."""
        return self.dilation + self.smoothing

    @property
    def compensated(self) -> float:
        """Of the widening, what opacities are compensated for."""
        return self.widening if self.antialias else self.smoothing

    def at_scale(self, scale: float) -> SplatModel:
        """The model for pictures that are `scale` times as large as the training pictures: the dilation scales along, and in smaller ones
        splats are smoothed by what their wider pixels average."""
        if self.antialias or scale == 1:
            return self
        return replace(self, dilation=self.dilation * scale**2, smoothing=self.smoothing + AVERAGED * max(0.0, 1 - scale**2))


@dataclass(frozen=True)
class Gaussians:
    """N Gaussian splats in a local frame (Kerbl et al. 2023). float32, one device; N may be 0.

    means `[N, 3]` metres; quats `[N, 4]` wxyz of any positive length; log_scales `[N, 3]` ln metres;
    logit_opacities `[N]`; sh `[N, K, 3]` with K in 1, 4, 9, 16.
    """

    means: torch.Tensor
    quats: torch.Tensor
    log_scales: torch.Tensor
    logit_opacities: torch.Tensor
    sh: torch.Tensor

    def __post_init__(self):
        check_tensor("means", self.means, ("N", 3), torch.float32)
        n = self.means.shape[0]
        check_tensor("quats", self.quats, (n, 4), torch.float32)
        check_tensor("log_scales", self.log_scales, (n, 3), torch.float32)
        check_tensor("logit_opacities", self.logit_opacities, (n,), torch.float32)
        check_tensor("sh", self.sh, (n, "K", 3), torch.float32)
        if self.sh.shape[1] not in SH_COUNTS:
            raise ValueError(f"sh must have 1, 4, 9 or 16 coefficients, got {self.sh.shape[1]}")
        if any(t.device != self.means.device for t in (self.quats, self.log_scales, self.logit_opacities, self.sh)):
            devices = sorted({str(t.device) for t in self.tensors().values()})
            raise ValueError(f"all fields must be on one device, got {', '.join(devices)}")

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def device(self) -> torch.device:
        return self.means.device

    @property
    def sh_degree(self) -> int:
        return SH_COUNTS.index(self.sh.shape[1])

    def tensors(self) -> dict[str, torch.Tensor]:
        """The five fields by name."""
        return {
            "means": self.means, "quats": self.quats, "log_scales": self.log_scales, "logit_opacities": self.logit_opacities, "sh": self.sh,
        }  # fmt: skip

    def map(self, change) -> Gaussians:
        """A copy with `change(tensor)` in place of every field."""
        return Gaussians(*(change(t) for t in self.tensors().values()))

    def to(self, device) -> Gaussians:
        return self.map(lambda t: t.to(device))

    def detach(self) -> Gaussians:
        return self.map(torch.Tensor.detach)

    def select(self, which: torch.Tensor) -> Gaussians:
        """The splats that a boolean mask or an index tensor names."""
        return self.map(lambda t: t[which])

    def with_sh_count(self, count: int) -> Gaussians:
        """The same splats with `count` SH coefficients: cut, or padded with zeros."""
        n, k, _ = self.sh.shape
        sh = self.sh[:, :count] if count <= k else torch.cat([self.sh, self.sh.new_zeros(n, count - k, 3)], 1)
        return replace(self, sh=sh)

    def invalid(self) -> torch.Tensor:
        """Mask `[N]` of splats with a value that is not finite or a quaternion of length zero."""
        bad = (self.quats == 0).all(1)
        for t in self.tensors().values():
            bad = bad | _not_finite(t)
        return bad

    def validate(self, where: str = "splats") -> None:
        """Raise ValueError naming the first splat and field that is not finite or not a rotation."""
        for name, t in self.tensors().items():
            if torch.isfinite(t.sum()):  # one value that is not finite makes the sum so: a pass over all splats, not five
                continue
            bad = _not_finite(t)
            if bad.any():
                first = int(bad.nonzero()[0])
                values = t[first].flatten()
                value = float(values[~torch.isfinite(values)][0])
                raise ValueError(f"{where}: splat {first} has {value} in {name}, which must be finite; {int(bad.sum())} such splats in all")
        zero = (self.quats == 0).all(1)
        if zero.any():
            first = int(zero.nonzero()[0])
            raise ValueError(f"{where}: splat {first} has a quaternion of length zero in quats; {int(zero.sum())} such splats in all")

    def checked(self, where: str = "splats") -> Gaussians:
        """These splats, after `validate`."""
        self.validate(where)
        return self

    @staticmethod
    def empty(sh_count: int = 1, device="cpu") -> Gaussians:
        z = lambda *s: torch.zeros(*s, dtype=torch.float32, device=device)  # noqa: E731
        return Gaussians(z(0, 3), z(0, 4), z(0, 3), z(0), z(0, sh_count, 3))

    @staticmethod
    def cat(parts: list[Gaussians]) -> Gaussians:
        """All splats of `parts` in order, with as many SH coefficients as the largest has."""
        if not parts:
            return Gaussians.empty()
        count = max(p.sh.shape[1] for p in parts)
        parts = [p.with_sh_count(count) for p in parts]
        return Gaussians(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(Gaussians)))


def _not_finite(field: torch.Tensor) -> torch.Tensor:
    """Mask `[N]` of splats with a value of `field` `[N, ...]` that is not finite."""
    bad = ~torch.isfinite(field)
    return bad.flatten(1).any(1) if field.ndim > 1 else bad


@dataclass(frozen=True)
class Placed:
    """Gaussians at a pose: `world_from_local` float64 `[4, 4]`; an end pose where it moves during the shutter. lattice: what has moved
    the splats already within their frame, for who follows a surface to where it is at another time."""

    gaussians: Gaussians
    world_from_local: torch.Tensor
    world_from_local_end: torch.Tensor | None = None
    instance: int = 0
    lattice: Lattice | None = None

    def __post_init__(self):
        if not isinstance(self.instance, Integral):
            raise ValueError(f"instance must be a whole number, got {self.instance!r}")
        for name in ("world_from_local", "world_from_local_end"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, as_pose(getattr(self, name)))
                check_tensor(name, getattr(self, name), (4, 4), torch.float64)

    def detach(self) -> Placed:
        end = self.world_from_local_end
        poses = (self.world_from_local.detach(), None if end is None else end.detach())
        return replace(self, gaussians=self.gaussians.detach(), world_from_local=poses[0], world_from_local_end=poses[1])
