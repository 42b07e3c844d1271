"""How well skies of any colour are known: a drive's pictures with other skies behind its street, lit to match.

    python -m tests.bench.skies DRIVE [--camera front_camera] [--size 480 270] [--only SKY ...] [--without-lidar] [--pictures FOLDER]
        [--envmaps FOLDER]

DRIVE's own sky must be blue: what of its pictures surely is, is the truth; 2 pixels at its rim, and holes of wires in it, do not count.
The other skies stand still in the world, as the real one does, and move through the pictures as the car turns. Precision and recall in
percent of pixels that count and lie above the horizon, over every eighth picture, of the mask on a grid of cells (coarse), of that by which
the sky's image is made (fine), and of that which fits are held to (rim).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy import ndimage

from recon.log import Log, LogCamera, Packed
from recon.views.frames import Frames, load_frames
from recon.views.skies import sky_mask
from render.rays import world_directions
from scenes.camera import Camera
from scenes.hdr import load_hdr
from scenes.sky import sample_equirect, srgb_from_linear
from tests.bench.recon import opened

SIZE = 960, 540
"""Of the pictures that are made."""

HEIGHT = 512


@dataclass(frozen=True)
class Look:
    """sky: sRGB float32 `[H, 2H, 3]`; gain `[3]`: what of the street's linear light is left; veil: part of the way to the sky's colour at
    the horizon that haze takes what is far; lamps; noise: levels."""

    sky: np.ndarray
    gain: tuple[float, float, float] = (1, 1, 1)
    veil: float = 0.0
    lamps: bool = False
    noise: float = 1.0


@cache
def _elevation() -> np.ndarray:
    """Degrees above the horizon `[H, 1, 1]` of an equirectangular image's rows."""
    return (90 - (np.arange(HEIGHT) + 0.5) * 180 / HEIGHT)[:, None, None]


@cache
def _fractal(seed: int) -> np.ndarray:
    """Clouds 0..1 `[H, 2H, 1]` with a bottom flatter than it is wide."""
    generator, total = np.random.default_rng(seed), np.zeros((HEIGHT, 2 * HEIGHT))
    for octave in range(5, 10):
        wave = ndimage.gaussian_filter(generator.normal(size=total.shape), (0.8 * HEIGHT / 2**octave, 2 * HEIGHT / 2**octave), mode="wrap")
        total += wave / wave.std() / 1.7**octave
    return ((total - total.min()) / np.ptp(total))[..., None]


def _between(*stops: tuple[float, tuple[float, float, float]]) -> np.ndarray:
    """Levels by elevation, from one stop (degrees, colour) to the next, as 0..1 `[H, 2H, 3]`."""
    degrees, colours = zip(*stops, strict=True)
    channels = [np.interp(_elevation()[:, 0, 0], degrees, [c[k] for c in colours]) for k in range(3)]
    return np.broadcast_to(np.stack(channels, -1)[:, None] / 255, (HEIGHT, 2 * HEIGHT, 3))


def _clouds(over: np.ndarray, colour: tuple[float, float, float], part: float, soft: float, seed: int = 0) -> np.ndarray:
    """A sky with clouds of a colour over a part of it."""
    noise = _fractal(seed)
    low = noise[np.abs(_elevation()[:, 0, 0] - 10) < 10]
    much = np.clip((noise - np.quantile(low, 1 - part)) / (soft * np.ptp(low)) + 0.5, 0, 1)
    return over * (1 - much) + much * (np.array(colour) / 255) * (0.75 + 0.5 * _fractal(seed + 1))


def _published(path: Path, exposure: float, turn: float) -> np.ndarray:
    """An HDR image as a sky, turned by parts of a circle: what is 12 to 60 degrees up in it, where no trees are, from the horizon on."""
    image = np.roll(load_hdr(path).numpy(), int(turn * 2 * HEIGHT), 1)
    rows = (90 - np.interp(_elevation()[:, 0, 0], [-90, 0, 30, 90], [12, 12, 60, 90])) / 180 * len(image)
    at = np.stack(np.meshgrid(rows, np.arange(2 * HEIGHT) * image.shape[1] / (2 * HEIGHT), indexing="ij"))
    light = np.stack([ndimage.map_coordinates(image[..., k], at, order=1, mode="nearest") for k in range(3)], -1)
    return srgb_from_linear(torch.from_numpy(light * exposure / np.median(light))).clamp(0, 1).numpy()


def _with_sun(sky: np.ndarray, column: float) -> np.ndarray:
    """A sky with the sun 9 degrees up at a part of its width, and its glare."""
    across = ((np.arange(2 * HEIGHT) / (2 * HEIGHT) - column + 0.5) % 1 - 0.5) * 360
    away = np.hypot(across[None, :, None], _elevation() - 9)
    return np.clip(sky + 3 * np.exp(-away / 1.5) + 0.6 * np.exp(-away / 10), 0, 1)


def looks(envmaps: Path, ahead: float) -> dict[str, Callable[[], Look]]:
    """The skies by name; ahead: where the drive goes, as a part of their width."""
    pink = _between((0, (250, 170, 110)), (8, (225, 150, 140)), (25, (150, 130, 165)))
    dusk = _between((0, (190, 110, 70)), (6, (120, 85, 100)), (20, (40, 42, 70)))
    return {
        "sunset, HDR": lambda: Look(_published(envmaps / "venice_sunset_1k.hdr", 0.6, 0.6), (0.75, 0.55, 0.42)),
        "sun in the picture, HDR": lambda: Look(
            _with_sun(_published(envmaps / "rooitou_park_1k.hdr", 0.4, 0.5), ahead - 0.02), (0.5, 0.47, 0.42)
        ),
        "pink and violet clouds": lambda: Look(_clouds(pink, (165, 120, 135), 0.5, 0.1), (0.6, 0.5, 0.5)),
        "orange clouds before blue": lambda: Look(
            _clouds(_between((0, (215, 190, 170)), (20, (95, 125, 175))), (225, 150, 95), 0.5, 0.05, 5), (0.7, 0.58, 0.45)
        ),
        "overcast": lambda: Look(
            _clouds(_between((0, (226, 226, 224)), (25, (205, 206, 208))), (215, 216, 219), 0.5, 0.4), (0.8, 0.82, 0.85)
        ),
        "storm, sun on the houses": lambda: Look(
            _clouds(_between((0, (125, 128, 135)), (20, (75, 78, 88))), (70, 72, 82), 0.5, 0.15), (1.3, 1.2, 1.0)
        ),
        "storm": lambda: Look(_clouds(_between((0, (150, 152, 155)), (20, (95, 98, 105))), (90, 93, 102), 0.5, 0.15), (0.35, 0.37, 0.4)),
        "fog": lambda: Look(_between((0, (186, 188, 190)), (30, (194, 196, 198))), (0.6, 0.62, 0.65), veil=1),
        "rain": lambda: Look(_between((0, (158, 160, 163)), (30, (142, 144, 148))), (0.45, 0.47, 0.5), veil=0.25, noise=3),
        "dusk": lambda: Look(_clouds(dusk, (100, 60, 70), 0.3, 0.1), (0.16, 0.15, 0.2), lamps=True, noise=2),
        "night": lambda: Look(_between((0, (26, 22, 20)), (20, (9, 9, 14))), (0.07, 0.06, 0.045), lamps=True, noise=3),
    }


def under(log: Log, name: str, look: Look, truth: list[np.ndarray]) -> Log:
    """The drive with a camera's pictures at `SIZE` under another sky; truth: where its own is seen."""
    camera = log.camera(name)
    small = replace(camera, lens=camera.camera(0, *SIZE).lens, width=SIZE[0], height=SIZE[1])
    files = tuple(
        Packed(f"{file}, under another sky", partial(_painted, log, camera, i, look, truth[i])) for i, file in enumerate(camera.files)
    )
    return replace(log, cameras={name: replace(small, files=files)}, front=(name,))


def _ahead(log: Log) -> float:
    forward = log.ego.world_from_body[0, :3, 0]
    return float(0.5 - torch.atan2(forward[1], forward[0]) / (2 * torch.pi))


def known(log: Log, name: str) -> list[np.ndarray]:
    """Where a camera's pictures at `SIZE` show their blue sky, bool `[H, W]` each."""
    return [_blue(log.camera(name).image(i, *SIZE)) for i in range(len(log.camera(name)))]


def _blue(picture: np.ndarray) -> np.ndarray:
    """What of a picture is surely blue sky, and what within a sixteenth of its width looks like it, between wires and leaves."""
    sure, reach = sky_mask(picture), picture.shape[1] // 16
    rgb = ndimage.uniform_filter(picture.astype(np.float64), (3, 3, 1))
    weight = ndimage.gaussian_filter(sure.astype(np.float64), reach / 2) + 1e-9
    beside = np.stack([ndimage.gaussian_filter(rgb[..., k] * sure, reach / 2) for k in range(3)], -1) / weight[..., None]
    alike = (np.abs(rgb - beside).max(-1) < 30) & (ndimage.distance_transform_edt(~sure) < reach)
    return sure | ndimage.binary_opening(alike, iterations=2)


def _painted(log: Log, camera: LogCamera, index: int, look: Look, sky: np.ndarray) -> bytes:
    own, packed = camera.image(index, *SIZE).astype(np.float64) / 255, BytesIO()
    at, generator = camera.camera(index, *SIZE), np.random.default_rng(index)
    new = sample_equirect(torch.tensor(look.sky).float(), world_directions(at)).numpy()
    # of what is mixed at the rim, as of leaves and wires, the part that is sky is told by how much it looks like it
    weight = ndimage.gaussian_filter(sky.astype(np.float64), 6) + 1e-6
    beside = np.stack([ndimage.gaussian_filter(own[..., k] * sky, 6) for k in range(3)], -1) / weight[..., None]
    rim = ndimage.binary_dilation(sky, iterations=4)
    part = np.where(sky, 1.0, rim * np.clip(1 - np.abs(own - beside).max(-1) / 0.35, 0, 1))[..., None]
    linear = np.clip(own - part * beside, 0, 1) ** 2.2
    lit = np.clip(linear * look.gain, 0, 1) ** (1 / 2.2)
    if look.veil:
        horizon = look.sky[HEIGHT // 2 - 4].mean(0)
        far = 1 - np.exp(-look.veil * _depth(log, at) / 90)[..., None]
        lit = lit * (1 - far * (1 - part)) + horizon * far * (1 - part)
    picture = 255 * (lit + part * new)
    if look.lamps:
        picture += _lamps(log.ego.world_from_body[0], at)
    picture = picture + generator.normal(size=picture.shape) * look.noise
    Image.fromarray(picture.clip(0, 255).astype(np.uint8)).save(packed, "JPEG", quality=93)
    return packed.getvalue()


def _depth(log: Log, camera: Camera) -> np.ndarray:
    """Metres to what each pixel shows, by the nearest point of lidar in the picture; with what is above it as far."""
    from recon.views.project import project
    from scenes.poses import inverse

    small = camera.resized(96, 54)
    sweep = min(log.sweeps, key=lambda s: abs(s.time_us - camera.time_us))
    row, column, z, inside = project(sweep.read().xyz, inverse(small.world_from_cam).numpy(), small)
    depth = np.full((54, 96), np.inf)
    np.minimum.at(depth, (row[inside], column[inside]), z[inside])
    rows, columns = ndimage.distance_transform_edt(~np.isfinite(depth), return_distances=False, return_indices=True)
    return ndimage.zoom(ndimage.gaussian_filter(depth[rows, columns], 1), 10, order=1)


def _lamps(start: torch.Tensor, camera: Camera) -> np.ndarray:
    """Street lamps `[h, w, 1]`, levels: along the street from where the body starts `[4, 4]`, 7 m up, with halos."""
    from recon.views.project import project
    from scenes.poses import inverse

    places = np.array([[12.0 + 18 * k, side, 7.0] for k in range(6) for side in (-6.0, 7.0)])
    places = places @ start[:3, :3].numpy().T + start[:3, 3].numpy()
    row, column, z, inside = project(places, inverse(camera.world_from_cam).numpy(), camera)
    y, x = np.mgrid[: camera.height, : camera.width]
    light = np.zeros((camera.height, camera.width))
    for r, c, metres in zip(row[inside], column[inside], z[inside], strict=True):
        away = np.hypot(y - r, x - c) * metres / 900
        light += 400 * np.exp(-((away / 0.25) ** 2)) + 45 * np.exp(-away / 1.2)
    return light[..., None]


def counted(truth: np.ndarray, camera: Camera) -> np.ndarray:
    """Which pixels of a camera's mask count, bool `[H, W]`: above the horizon, not at the rim, and not in what wires enclose."""
    rim = ndimage.binary_dilation(truth, iterations=2) & ~ndimage.binary_erosion(truth, iterations=2, border_value=1)
    closed = ndimage.binary_closing(np.pad(truth, 12, mode="edge"), iterations=6)[12:-12, 12:-12]
    return ~rim & ~(closed & ~truth) & (world_directions(camera)[..., 2].numpy() > 0)


def scores(frames: Frames, log: Log, truth: list[np.ndarray]) -> dict[str, tuple[float, float]]:
    """Precision and recall of the masks of a one-camera drive, in percent."""
    sums = {kind: np.zeros(3) for kind in ("coarse", "fine", "rim")}
    for view in frames.views[:: max(1, len(frames.views) // 10)]:
        camera = frames.camera(log, view)
        w, h = camera.width, camera.height
        true = np.asarray(Image.fromarray(truth[view.index]).resize((w, h), Image.Resampling.NEAREST))
        counts = counted(true, camera)
        rows, columns = (np.arange(n) * of // n for n, of in zip((h, w), view.sky.shape, strict=True))
        masks = view.sky.numpy()[rows[:, None], columns], frames.sky_of(view), frames.sky_with_rim(view)
        for kind, mask in zip(sums, masks, strict=True):
            sums[kind] += (mask & true & counts).sum(), (mask & counts).sum(), (true & counts).sum()
    return {kind: (100 * both / max(found, 1), 100 * both / there) for kind, (both, found, there) in sums.items()}


def picture_of(frames: Frames) -> np.ndarray:
    """Some of the pictures beside their coarse masks, green, and fine ones, red."""
    rows = []
    for view in frames.views[4 :: max(1, len(frames.views) // 3)]:
        image, fine = view.image.numpy(), frames.sky_of(view)
        r, c = (np.arange(n) * of // n for n, of in zip(fine.shape, view.sky.shape, strict=True))
        coarse = view.sky.numpy()[r[:, None], c]
        rows.append(
            np.concatenate([image, np.where(coarse[..., None], (0, 255, 0), image), np.where(fine[..., None], (255, 0, 0), image)], 1)
        )
    return np.concatenate(rows).astype(np.uint8)


def frames_of(log: Log, size: tuple[int, int]) -> Frames:
    """A drive's pictures with their skies, as a fit begins with them."""
    return load_frames(log, list(log.cameras), (0, 2**62), size, 8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drive", type=Path)
    parser.add_argument("--camera", default="front_camera")
    parser.add_argument("--size", type=int, nargs=2, default=(480, 270), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--only", nargs="+", default=())
    parser.add_argument("--without-lidar", action="store_true")
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--envmaps", type=Path, default=Path("../shared/data/envmaps"))
    asked = parser.parse_args()
    log, name, size = opened(asked.drive), asked.camera, (asked.size[0], asked.size[1])
    truth = known(log, name)
    print(f"{'':<28} {'coarse':>14} {'fine':>14} {'rim':>14}   (precision, recall; percent)")
    for sky, look in looks(asked.envmaps, _ahead(log)).items():
        if asked.only and sky not in asked.only:
            continue
        drive = under(log, name, look(), truth)
        frames = frames_of(replace(drive, sweeps=(), tracks=()) if asked.without_lidar else drive, size)
        found = scores(frames, drive, truth)
        print(f"{sky:<28} " + " ".join(f"{p:>6.1f} {r:>6.1f} " for p, r in found.values()), flush=True)
        if asked.pictures:
            asked.pictures.mkdir(parents=True, exist_ok=True)
            Image.fromarray(picture_of(frames)).save(asked.pictures / f"{sky}.png")


if __name__ == "__main__":
    main()
