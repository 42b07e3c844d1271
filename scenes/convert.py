"""One splat file becomes another, and how faithfully."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import torch

from scenes.asset import Asset
from scenes.axes import upright
from scenes.files import load, save
from scenes.formats import USD, named
from scenes.formats.axis import loaded_axis
from scenes.formats.transform import moved
from scenes.gaussians import SH_COUNTS, Gaussians, SplatModel


@dataclass(frozen=True)
class Fidelity:
    """How far splats are, at most, from those they were made of, and what each takes."""

    splats: int
    bytes: int
    """Of all splats together."""
    position: float
    """Metres."""
    rotation: float
    """Degrees."""
    scale: float
    """Part of the scale, as 0.03."""
    opacity: float
    """Of an opacity from 0 to 1."""
    sh: float
    """Of a coefficient, of those that both have."""
    lost_degree: int | None
    """The degree of harmonics before, where it is less now."""

    def __str__(self) -> str:
        size = f"{self.splats} splat{'s' * (self.splats != 1)}, {self.bytes / max(1, self.splats):.1f} bytes each"
        most = (
            f"{self.position:.2g} m, {self.rotation:.2g} deg, {self.scale:.2g} of scale, {self.opacity:.2g} of opacity, {self.sh:.2g} of SH"
        )
        if not any(getattr(self, f.name) for f in fields(self)[2:7]):
            most = "nothing"
        lost = "" if self.lost_degree is None else f"; harmonics of degree {self.lost_degree} are left out"
        return f"{size}; off by at most {most}{lost}"


def stood_up(gaussians: Gaussians, path: Path, up: str) -> Gaussians:
    """The loaded splats of a file, turned so that its axis `up`, as "-y", is z. ValueError where it is no axis."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.from_numpy(upright(loaded_axis(path, up)))
    return moved(gaussians, pose, path)


def convert(thing: Asset | Gaussians, target: Path, overwrite: bool = False, model: SplatModel | None = None) -> Fidelity:
    """Write splats or an asset as what the target's suffix says, and read them back to compare. Errors are those of `save`.

    An asset keeps its label, size and metadata only as USD; elsewhere its splats are written, and how they were trained as of `save`.
    """
    form = named(target)
    gaussians = thing.gaussians if isinstance(thing, Asset) else thing
    save(thing if form is USD else gaussians, target, overwrite, model=thing.model if isinstance(thing, Asset) else model)
    after = load(target)
    assert form is not None and isinstance(after, Asset | Gaussians)  # `save` knew the suffix, and a file is no scene
    return fidelity(form.arranged(gaussians), after.gaussians if isinstance(after, Asset) else after, target.stat().st_size)


def fidelity(before: Gaussians, after: Gaussians, size: int) -> Fidelity:
    """Compare splats of one order and number; `size` in bytes is that of the file of the later ones."""
    if len(before) != len(after):
        raise ValueError(f"there were {len(before)} splats and there are {len(after)}: they cannot be compared")
    shared = min(before.sh.shape[1], after.sh.shape[1])
    return Fidelity(
        splats=len(after),
        bytes=size,
        position=_most((before.means - after.means).norm(dim=1)),
        rotation=_most(_angles(before.quats, after.quats)),
        scale=_most((before.log_scales.double() - after.log_scales.double()).abs().expm1()),
        opacity=_most((before.logit_opacities.double().sigmoid() - after.logit_opacities.double().sigmoid()).abs()),
        sh=_most((before.sh[:, :shared] - after.sh[:, :shared]).abs()),
        lost_degree=before.sh_degree if SH_COUNTS[before.sh_degree] > shared else None,
    )


def _most(differences: torch.Tensor) -> float:
    return float(differences.max()) if differences.numel() else 0.0


def _angles(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Degrees `[N]` between rotations of quaternions `[N, 4]`, from their chord: an arc cosine would lose half the digits."""
    if torch.equal(a, b):
        return torch.zeros(len(a))
    a, b = (_unit(q.double()) for q in (a, b))
    chord = torch.minimum((a - b).norm(dim=1), (a + b).norm(dim=1))
    return torch.rad2deg(4 * torch.asin((chord / 2).clamp_max(1)))


def _unit(quats: torch.Tensor) -> torch.Tensor:
    quats = quats / quats.abs().amax(1, keepdim=True)
    return quats / quats.norm(dim=1, keepdim=True)
