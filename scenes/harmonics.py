"""Real spherical harmonics to degree 3 with the constants and order that all 3DGS tools share."""

import torch

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
C3 = (
    -0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154,
    -0.4570457994644658, 1.445305721320277, -0.5900435899266435,
)  # fmt: skip


def sh_from_rgb(rgb):
    """The constant coefficient that shows `rgb`; a tensor or an array."""
    return (rgb - 0.5) / C0


def rgb_from_sh(dc):
    """The colour that a constant coefficient shows; of a tensor or an array."""
    return dc * C0 + 0.5


def brighter(sh: torch.Tensor, times: torch.Tensor) -> torch.Tensor:
    """Coefficients `[N, K, 3]` of colours so many `times` `[3]` as bright."""
    return torch.cat([sh[:, :1] * times + sh_from_rgb(0.5 * times), sh[:, 1:] * times], 1)


def basis(directions: torch.Tensor, count: int) -> torch.Tensor:
    """The first `count` (1, 4, 9, 16) basis functions `[..., count]` at unit directions `[..., 3]`."""
    x, y, z = directions.unbind(-1)
    out = [torch.full_like(x, C0)]
    if count > 1:
        out += [-C1 * y, C1 * z, -C1 * x]
    if count > 4:
        xx, yy, zz = x * x, y * y, z * z
        out += [C2[0] * x * y, C2[1] * y * z, C2[2] * (2 * zz - xx - yy), C2[3] * x * z, C2[4] * (xx - yy)]
        if count > 9:
            out += [
                C3[0] * y * (3 * xx - yy), C3[1] * x * y * z, C3[2] * y * (4 * zz - xx - yy),
                C3[3] * z * (2 * zz - 3 * xx - 3 * yy), C3[4] * x * (4 * zz - xx - yy),
                C3[5] * z * (xx - yy), C3[6] * x * (xx - 3 * yy),
            ]  # fmt: skip
    return torch.stack(out, -1)


def evaluate(sh: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """Colours `[N, 3]`, clamped below at 0, of coefficients `[N, K, 3]` seen along unit directions `[N, 3]` from the eye."""
    return ((basis(directions, sh.shape[1])[..., None] * sh).sum(1) + 0.5).clamp_min(0)


def turned(sh: torch.Tensor, transform: torch.Tensor) -> torch.Tensor:
    """Harmonics `[N, K, 3]` of colours whose directions an orthogonal `[3, 3]` maps: rotations and mirrors alike.

    Bands map to themselves, so K well-spread directions determine the matrix exactly.
    """
    count = sh.shape[1]
    directions = torch.randn(64, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    directions = directions / directions.norm(dim=1, keepdim=True)
    matrix = torch.linalg.lstsq(basis(directions, count), basis(directions @ transform, count)).solution
    return torch.einsum("kj,njc->nkc", matrix.to(sh), sh)
