"""Other light by NVIDIA's DiffusionRenderer (Liang et al. 2025), for relight pairs: photos go out to it, and come back under other skies.

Its two networks take a GPU with 27 GB and an environment of their own. So it is not called but met in a folder, laid out as its published
scripts do (nv-tlabs/cosmos1-diffusion-renderer): `photos/<clip>/0000.png` is written here, `inference_inverse_renderer.py` makes
`gbuffer_frames/<clip>/` of it, and `inference_forward_renderer.py --save_image True` `relit/relit_frames_<light>/<clip>/0000.<frame>.jpg`,
1280x704 whatever the photos' shape. Unverified: its weights were not at hand.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from recon.log import LogCamera
from scenes.atomic import atomic_file
from scenes.pictures import opened

FRAMES = 57
"""Frames that it takes at once; shorter clips it fills up with their last one, longer ones it cuts."""

COMMANDS = """\
  python cosmos_predict1/diffusion/inference/inference_inverse_renderer.py --checkpoint_dir checkpoints \\
    --diffusion_transformer_dir Diffusion_Renderer_Inverse_Cosmos_7B --num_video_frames {frames} --group_mode folder \\
    --save_video False --dataset_path {folder}/photos --video_save_folder {folder}
  python cosmos_predict1/diffusion/inference/inference_forward_renderer.py --checkpoint_dir checkpoints \\
    --diffusion_transformer_dir Diffusion_Renderer_Forward_Cosmos_7B --num_video_frames {frames} --save_image True \\
    --envlight_ind 0 1 2 3 --dataset_path {folder}/gbuffer_frames --video_save_folder {folder}/relit"""


@dataclass(frozen=True)
class Relit:
    """Photos of clips under other skies, in the folder that DiffusionRenderer is met in."""

    folder: Path

    def lights(self, clip: str, frames: int) -> list[str]:
        """The lights under which all frames of a clip are there."""
        found = sorted(self.folder.glob("relit/relit_frames_*"))
        return [f.name for f in found if all(self._file(f.name, clip, i).is_file() for i in range(frames))]

    def read(self, light: str, clip: str, frames: int, size: tuple[int, int]) -> torch.Tensor:
        """A clip under a light, uint8 `[T, H, W, 3]` of a size (width, height). ValueError naming a file that does not decode."""
        pictures = []
        for file in (self._file(light, clip, i) for i in range(frames)):
            with opened(file, str(file), "run the forward renderer again") as picture:
                pictures.append(np.array(picture.convert("RGB").resize(size, Image.Resampling.LANCZOS)))
        return torch.from_numpy(np.stack(pictures))

    def ask(self, camera: LogCamera, clip: str, indices: range) -> None:
        """Put a clip's photos there."""
        for k, i in enumerate(indices):
            file = self.folder / "photos" / clip / f"{k:04d}.png"
            if not file.exists():
                file.parent.mkdir(parents=True, exist_ok=True)
                with atomic_file(file) as half:
                    Image.fromarray(camera.image(i)).save(half, "png")

    def commands(self) -> str:
        """What to run, in a checkout of cosmos1-diffusion-renderer with its weights."""
        return COMMANDS.format(folder=self.folder.resolve(), frames=FRAMES)

    def _file(self, light: str, clip: str, frame: int) -> Path:
        return self.folder / "relit" / light / clip / f"0000.{frame:04d}.jpg"
