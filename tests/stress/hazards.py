"""What breaks rasterizers, by name: each hazard makes pictures that must come out finite, with finite gradients.

`python -m tests.stress` prints the table; pytest runs the same cases (tests/stress/test_hazards.py).
"""

from __future__ import annotations

import math
import resource
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import torch

from render import RenderConfig, rasterize
from scenes import Camera, Gaussians, Pinhole, Placed, SplatModel
from scenes.poses import pose_from, translation
from tests import oracle
from tests.bench.presets import random_splats

EWA, UT = SplatModel(projection="ewa"), SplatModel(projection="ut")
STILL = torch.eye(4, dtype=torch.float64)
SMALL = Camera(Pinhole(60.0, 62.0, 34.0, 22.0), 70, 50, STILL)
MOST_BYTES = 3 << 30
"""What drawing and differentiating any of these may take at most beyond what was held before."""


@dataclass(frozen=True)
class Case:
    """One picture to draw. `empty`: nothing of it may show. `truth`: small enough to hold against the oracle, whose numbers float32
    can follow."""

    name: str
    placed: list[Placed]
    camera: Camera = SMALL
    model: SplatModel = UT
    empty: bool = False
    truth: bool = True
    backward: bool = True
    order: str = "tile"


@dataclass
class Outcome:
    """What came of a hazard's cases: how many, what went wrong, the longest one's milliseconds, the most memory in bytes."""

    cases: int = 0
    failures: list[str] = field(default_factory=list)
    milliseconds: float = 0.0
    memory: int = 0


HAZARDS: dict[str, Callable[[], Iterator[Case]]] = {}


def hazard(make: Callable[[], Iterator[Case]]) -> Callable[[], Iterator[Case]]:
    """Put a generator of cases on the list, under its name in words."""
    HAZARDS[make.__name__.replace("_", " ")] = make
    return make


def ahead(g: Gaussians, z: float = 5.0) -> list[Placed]:
    return [Placed(g, translation(0, 0, z))]


def with_one(value: float, name: str, of: int = 60, seed: int = 12) -> Gaussians:
    """A cloud in which splat 7 has `value` throughout one field."""
    g = random_splats(of, seed)
    tensor = getattr(g, name).clone()
    tensor[7] = value
    return replace(g, **{name: tensor})


@hazard
def no_splats() -> Iterator[Case]:
    yield Case("none", [Placed(Gaussians.empty(), STILL)], empty=True)
    yield Case("none among some", [*ahead(random_splats(20, 0)), Placed(Gaussians.empty(), STILL, instance=1)])


@hazard
def a_million_splats_behind_the_camera() -> Iterator[Case]:
    yield Case("behind", ahead(random_splats(1_000_000, 1, sh_count=1), -10), empty=True, truth=False)


@hazard
def a_hundred_thousand_splats_in_one_tile() -> Iterator[Case]:
    g = random_splats(100_000, 2, sh_count=1)
    g = replace(g, means=g.means * torch.tensor([0.02, 0.02, 1.0]), log_scales=torch.full_like(g.log_scales, -5.0))
    yield Case("one tile", ahead(g, 8), replace(SMALL, lens=Pinhole(60.0, 60.0, 24.0, 24.0)), truth=False)


@hazard
def one_splat_over_a_4k_image() -> Iterator[Case]:
    camera = Camera(Pinhole(2000.0, 2000.0, 1920.0, 1080.0), 3840, 2160, STILL)
    g = replace(random_splats(1, 3), means=torch.zeros(1, 3), log_scales=torch.full((1, 3), 2.0), logit_opacities=torch.zeros(1))
    for model in (EWA, UT):
        yield Case(model.projection, ahead(g, 6), camera, model, truth=False)


@hazard
def opacity_at_zero_and_one() -> Iterator[Case]:
    g = random_splats(60, 4)
    for value in (-1e30, -200.0, 200.0, 1e30):
        yield Case(f"logit {value:g}", ahead(replace(g, logit_opacities=torch.full((60,), value))), empty=value < 0)


@hazard
def many_opaque_layers_beside_a_gap() -> Iterator[Case]:
    for layers in (50, 1000):
        g = random_splats(layers, 5, sh_count=1)
        means = torch.stack([torch.full((layers,), -1.2), torch.zeros(layers), torch.linspace(-1, 1, layers)], 1)
        walls = replace(g, means=means, log_scales=torch.full((layers, 3), -0.3), logit_opacities=torch.full((layers,), 12.0))
        yield Case(f"{layers} layers", [*ahead(walls), *ahead(random_splats(30, 6), 9)], truth=layers < 100)


@hazard
def scales_from_nothing_to_a_city() -> Iterator[Case]:
    for metres in (1e-30, 1e-8, 1e-4, 1e2, 1e4, 1e30):
        for model in (EWA, UT):
            g = with_one(math.log(metres), "log_scales")
            yield Case(f"{metres:g} m, {model.projection}", ahead(g), model=model, truth=metres < 1e3)


@hazard
def needles_and_pancakes() -> Iterator[Case]:
    g = random_splats(60, 7)
    for shape in ([2.0, -6.0, -6.0], [1.0, 1.0, -12.0], [4.0, -12.0, 0.0]):
        for model in (EWA, UT, replace(UT, antialias=True), replace(EWA, dilation=0.0)):
            yield Case(f"{shape}, {model}", ahead(replace(g, log_scales=torch.tensor([shape]).repeat(60, 1))), model=model, truth=False)


@hazard
def quaternions_of_any_length() -> Iterator[Case]:
    for value in (0.0, 1e-42, 1e-20, 1e18):
        yield Case(f"{value:g}", ahead(with_one(value, "quats")), truth=1e-20 <= value <= 1)


@hazard
def splats_at_the_camera_plane() -> Iterator[Case]:
    for z in (-0.1, 0.0, 0.0999, 0.1, 0.1001, 0.2):
        g = with_one(0.0, "means")
        g.means[:, 2] *= 0.05
        for model in (EWA, UT):
            yield Case(f"z {z:g} m, {model.projection}", ahead(g, z), model=model)


@hazard
def splats_beside_the_car() -> Iterator[Case]:
    g = random_splats(100, 8)
    wide = replace(g, means=g.means * torch.tensor([4.0, 3.0, 1.0]), log_scales=g.log_scales + 1.5)
    for model in (EWA, UT):
        yield Case(model.projection, ahead(wide, 1.5), model=model)


@hazard
def far_from_the_origin() -> Iterator[Case]:
    for metres in (1e4, 1e6, 1e7):
        away = pose_from([1, 0.2, 0.1, -0.3], [metres, -metres, 0.3 * metres])
        placed = [replace(p, world_from_local=away @ p.world_from_local) for p in ahead(random_splats(60, 9))]
        yield Case(f"{metres:g} m", placed, replace(SMALL, world_from_cam=away))
    yield Case("means at 1e30 m", ahead(with_one(1e30, "means")))


@hazard
def one_value_that_is_not_a_number() -> Iterator[Case]:
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh"):
        for value in (math.nan, math.inf, -math.inf):
            yield Case(f"{value} in {name}", ahead(with_one(value, name)), truth=False)


@hazard
def colours_beyond_measure() -> Iterator[Case]:
    for value in (1e4, -1e4, 1e30, -1e30, 3e38):
        yield Case(f"{value:g}", ahead(with_one(value, "sh")), truth=False)


@hazard
def images_of_any_size() -> Iterator[Case]:
    for width, height in ((1, 1), (15, 17), (8192, 1), (1, 8192), (33, 2)):
        camera = Camera(Pinhole(40.0, 40.0, width / 2, height / 2), width, height, STILL)
        yield Case(f"{width}x{height}", ahead(random_splats(60, 10)), camera, truth=width * height < 20_000)


@hazard
def lenses_of_any_length_and_centre() -> Iterator[Case]:
    for numbers in ((0.5, 0.5, 35.0, 25.0), (1e5, 1e5, 35.0, 25.0), (60.0, 60.0, -500.0, 900.0), (60.0, 6.0, 70.0, 0.0)):
        camera = replace(SMALL, lens=Pinhole(*numbers))
        for model in (EWA, UT):
            yield Case(f"{numbers}, {model.projection}", ahead(random_splats(60, 11)), camera, model, truth=numbers[0] < 1e4)


@hazard
def equal_depths() -> Iterator[Case]:
    g = random_splats(80, 13)
    yield Case("a flat wall", ahead(replace(g, means=g.means * torch.tensor([1.0, 1.0, 0.0]))))
    yield Case("copies", ahead(g.select(torch.zeros(80, dtype=torch.long))))


def examine(case: Case, device: str = "cpu") -> list[str]:
    """Draw it and differentiate; what is wrong, in words."""
    wrong = []
    placed = [replace(p, gaussians=p.gaussians.to(device).map(lambda t: t.detach().clone().requires_grad_())) for p in case.placed]
    pose = case.camera.world_from_cam.clone().requires_grad_()
    camera = replace(case.camera, world_from_cam=pose)
    frame = rasterize(placed, camera, ("rgb", "alpha", "depth"), model=case.model, config=RenderConfig(order=case.order))
    for name in ("rgb", "alpha"):
        if not getattr(frame, name).isfinite().all():
            wrong.append(f"{name} is not finite")
    if frame.alpha.min() < 0 or frame.alpha.max() > 1:
        wrong.append(f"alpha from {float(frame.alpha.min()):g} to {float(frame.alpha.max()):g}")
    if frame.depth.isnan().any() or frame.depth.min() < 0:
        wrong.append("depth is nan or negative")
    if case.empty and frame.alpha.max() > 0:
        wrong.append("something shows that should not")
    if case.backward:
        drawn = frame.depth.isfinite()
        (frame.rgb.sum() + frame.alpha.square().sum() + frame.depth[drawn].sum()).backward()
        for p in placed:
            grads = {n: t.grad for n, t in p.gaussians.tensors().items() if t.grad is not None}
            wrong += [f"gradient of {n} is not finite" for n, grad in grads.items() if not grad.isfinite().all()]
        if not pose.grad.isfinite().all():
            wrong.append("gradient of the camera's pose is not finite")
    if case.truth:
        with torch.no_grad():
            config = RenderConfig(termination=0, order=case.order)
            frame = rasterize(placed, case.camera, ("rgb",), model=case.model, config=config)
            truth, _, _, _, edge = oracle.render(
                oracle.as_oracle(case.placed), case.camera, case.model, cutoff=1 / 255, alpha_max=0.999, order=case.order,
                world_from_cam_end=case.camera.world_from_cam_end, ends=[p.world_from_local_end for p in case.placed],
            )  # fmt: skip
        off = (frame.rgb.cpu().double() - truth).abs()[~edge]
        # beyond pixel 2048 a float's step is 2.4e-4 px, which a splat of one pixel shows as 1e-4
        limit = (1e-4 if max(case.camera.width, case.camera.height) > 2048 else 2.5e-5) * max(1.0, float(truth.max()))
        if off.numel() and off.max() > limit:
            wrong.append(f"{float(off.max()):.1e} from the oracle, {limit:.1e} allowed")
    return wrong


def run(name: str, device: str = "cpu") -> Outcome:
    """All cases of one hazard."""
    outcome = Outcome()
    for case in HAZARDS[name]():
        _measure(outcome, lambda c=case: [f"{c.name}: {what}" for what in examine(c, device)])
    return outcome


def run_conduct(check: Callable[[str], list[str]], device: str = "cpu") -> Outcome:
    """One conduct, as one case."""
    outcome = Outcome()
    _measure(outcome, lambda: check(device))
    return outcome


def _measure(outcome: Outcome, work: Callable[[], list[str]]) -> None:
    held = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    start = time.perf_counter()
    outcome.failures += work()
    outcome.milliseconds = max(outcome.milliseconds, 1000 * (time.perf_counter() - start))
    taken = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - held
    outcome.memory = max(outcome.memory, taken)
    if taken > MOST_BYTES:
        outcome.failures.append(f"took {taken / 2**30:.1f} GiB")
    outcome.cases += 1


def table(outcomes: dict[str, Outcome]) -> str:
    """Hazards, cases and failures in Markdown; milliseconds and memory are for people, no test asserts them but the memory's bound."""
    lines = ["| hazard | cases | failures | slowest, ms | most new memory, MiB |", "|---|---|---|---|---|"]
    for name, o in outcomes.items():
        lines.append(f"| {name} | {o.cases} | {len(o.failures)} | {o.milliseconds:.0f} | {o.memory / 2**20:.0f} |")
    total = sum(o.cases for o in outcomes.values()), sum(len(o.failures) for o in outcomes.values())
    return "\n".join([*lines, f"| all | {total[0]} | {total[1]} | | |"])
