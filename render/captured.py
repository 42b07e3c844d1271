"""A camera's pictures of the same splats, from pose to pose, recorded once as a CUDA graph and replayed.

A frame is some thirty launches, which at small sizes take the host longer than the GPU. Nothing in a recorded frame asks the device
anything (`render/room.py`): only poses go up, and a count comes back, a frame later. Recorded anew where the room has grown.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import torch
import warp as wp

from render.bridge import paint, pictures, prepare, told_of
from render.frame_types import Frame, RenderConfig
from render.kernels.types import Wanted
from render.launch import stage, upload
from render.outputs import check_outputs
from render.projection import check_projection, moves, poses
from render.rasterize import as_placed, check, check_part, check_poses, picture_of
from render.room import Room, one_ahead
from render.settings import Settings
from scenes.camera import Camera
from scenes.gaussians import Gaussians, Placed, SplatModel

OUTPUTS = ("rgb", "alpha", "depth", "median_depth", "instance")


class Captured:
    """`rasterize` of still splats for many poses of one camera, without gradients; on the CPU it draws as ever, in a room.

    splats, outputs, background, model, config: as of `rasterize`, but response "conic", order "tile" and the outputs rgb, alpha, depth,
    median_depth and instance: the others are made with numbers that the host has anew for every pose. camera: lens, size and shutter that
    all poses share. ValueError for what cannot be recorded.
    """

    def __init__(
        self,
        splats: Gaussians | Placed | Sequence[Placed],
        camera: Camera,
        outputs: tuple[str, ...] = ("rgb", "alpha"),
        background: torch.Tensor | None = None,
        model: SplatModel = SplatModel(),  # noqa: B008 - frozen
        config: RenderConfig = RenderConfig(),  # noqa: B008 - frozen
        room: Room | None = None,
    ):
        self.outputs = check_outputs(outputs)
        for name in self.outputs:
            if name not in OUTPUTS:
                raise ValueError(f'output "{name}" cannot be captured, only {", ".join(OUTPUTS)}; use rasterize')
        self.placed, self.camera = as_placed(splats), camera
        self._device = self.placed[0].gaussians.device
        self.background = None if background is None else torch.as_tensor(background).to(self._device)
        self.room = room or Room()
        check(self.placed, camera, self.outputs, {}, model)
        check_part(camera, self.background, None, None)
        self._settings = Settings(
            width=camera.width,
            height=camera.height,
            model=model,
            config=config,
            wanted=Wanted("depth" in self.outputs, "median_depth" in self.outputs, "instance" in self.outputs),
            instances=tuple(p.instance for p in self.placed),
            lens=type(camera.lens),
            shutter=camera.shutter,
            rolling=moves(camera, self.placed),
            gradients=False,
            room=self.room,
        )
        if self._settings.by_rays:
            raise ValueError('response "ray" and order "pixel" cannot be captured; use rasterize')
        fields = [t for p in self.placed for t in p.gaussians.tensors().values()]
        self._lens = camera.lens.params()
        self._todo, self._told, rows = prepare(self._settings, None, poses(camera, self.placed), self._lens, fields)
        self._rows = upload(rows, self._device)
        self._graph: torch.cuda.CUDAGraph | None = None
        # for how many entries; the graph's pictures, and the counts that it leaves
        self._recorded: tuple[int, dict[str, torch.Tensor], list[torch.Tensor]] = (0, {}, [])

    def frames(self, cameras: Iterable[Camera]) -> Iterator[Frame]:
        """The frames of cameras that differ in their poses and times alone; see `one_ahead`."""
        return one_ahead(self._draw, cameras, self.room)

    def _draw(self, camera: Camera) -> Frame:
        if self._shared(camera) != self._shared(self.camera):
            raise ValueError("all cameras of a CUDA graph must share lens, size and shutter; make another Captured for this one")
        check_poses([], camera)
        check_projection(camera, self.placed, self._settings.model)
        with torch.no_grad():
            _, rows = told_of(self._settings, poses(camera, self.placed), self._lens)
            self._rows.copy_(upload(rows, self._device))
        if self._device.type != "cuda":
            with stage(self._device):
                return Frame(camera, **self._paint())
        if self._graph is None or self._recorded[0] != self.room.entries:
            self._record()
        assert self._graph is not None
        self._graph.replay()
        _, recorded, needed = self._recorded
        for count in needed:
            self.room.note(count)
        return Frame(camera, **{name: picture.clone() for name, picture in recorded.items()})

    def _shared(self, camera: Camera) -> tuple:
        return camera.lens.key(), camera.width, camera.height, camera.shutter, moves(camera, self.placed)

    def _paint(self) -> dict[str, torch.Tensor]:
        with torch.no_grad():
            _, picture = paint(self._settings, self._todo, self._told, self._rows, None, None, None)
            made = picture_of(self._settings, self.background, *pictures(self._settings, picture))
        return {name: made[name] for name in self.outputs}

    def _record(self) -> None:
        stream = torch.cuda.Stream(self._device)
        stream.wait_stream(torch.cuda.current_stream(self._device))
        with wp.ScopedStream(wp.stream_from_torch(stream), sync_enter=False):
            with torch.cuda.stream(stream):
                self._paint()  # loads kernels, and makes sorts reserve what they need: neither can be recorded
            self.room.noted()
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph, stream=stream):
                wp.capture_begin(force_module_load=False, external=True)
                try:
                    recorded = self._paint()
                finally:
                    wp.capture_end()
        self._graph, self._recorded = graph, (self.room.entries, recorded, self.room.noted())
