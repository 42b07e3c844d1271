"""How long and how finely to fit, and what is corrected on the way."""

from __future__ import annotations

from dataclasses import dataclass, replace

from recon.fit.motion import REFINED


@dataclass(frozen=True)
class FitConfig:
    """How long and how finely to fit."""

    steps: int = 4000
    """Pictures rendered and compared."""
    budget: int = 220_000
    """Splats at most, all groups together."""
    sh_degree: int = 1
    """Harmonics of the splats' colours; they rise from 0 a quarter of the way in."""
    stages: tuple[tuple[float, int], ...] = ((0.0, 4), (0.15, 2), (0.4, 1))
    """From which part of the fit on pictures are shrunk by which factor: coarse to fine."""
    grow_every: int = 100
    """Steps between densifications."""
    grow_span: tuple[float, float] = (0.06, 0.6)
    """Part of the fit within which splats are added."""
    refine: tuple[str, ...] = ("path", "surfaces", "road", "gains", *REFINED, "exposures", "flat fields", "limbs")
    """What is corrected besides the splats and the sky: before the fit (`recon/registration`) the body's path by lidar (`align.py`), where
    cameras are fixed to it by what they show of lidar's surfaces (`mounts_by_surfaces.py`) and of the road (`mounts_by_road.py`), and how
    frames were exposed, by what several show (`recon/views/gains.py`); in it poses and clocks by kind, the cameras' exposures against the
    first's, how much of the light they show over their pictures, and how the limbs of people and animals stand."""
    poses_from: float = 0.1
    """Part of the fit from which poses are corrected."""
    dissimilarity: float = 0.2
    """Weight of 1 - SSIM against L1."""
    still_weight: float = 0.4
    """How often a view is drawn while the car stands, against one while it drives."""
    drop: float = 0.0
    """Part of the splats in sight that a step leaves out of its picture, by lot, towards the end; the others are denser for them. Where few
    photos see a place, none may serve one photo alone (DropGaussian, Park et al. 2025)."""
    depth_weight: float = 1.0
    """Of depths that are not as measured, times what suits who measured them (`recon/seeds/measured.py`)."""
    seed: int = 0
    """Of the order of views."""

    def without(self, *kinds: str) -> FitConfig:
        """The same fit that leaves these of `refine` as they are."""
        return replace(self, refine=tuple(kind for kind in self.refine if kind not in kinds))
