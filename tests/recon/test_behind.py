import torch

from recon.fit.behind import masked, sampled
from recon.views.skies import cells
from scenes.sky import sample_equirect


def directions(count=4000):
    """All around, of any length, and along the axes."""
    around = torch.randn(count, 3, generator=torch.Generator().manual_seed(3)) * 2
    return torch.cat([around, torch.eye(3), -torch.eye(3)]).view(-1, 2, 3)


def test_a_picture_and_its_gradient_are_as_sampled_plainly():
    generator = torch.Generator().manual_seed(4)
    for height in (1, 2, 24):
        picture = torch.rand(height, 2 * height, 3, generator=generator, requires_grad=True)
        weights = torch.rand(*directions().shape, generator=generator)
        found, plain = (look(picture, directions()) for look in (sampled, sample_equirect))
        torch.testing.assert_close(found, plain, atol=1e-5, rtol=0)
        slopes = [torch.autograd.grad((colours * weights).sum(), picture)[0] for colours in (found, plain)]
        torch.testing.assert_close(*slopes, atol=1e-3, rtol=1e-4)


def test_a_mask_is_looked_up_as_its_cells_are_found():
    mask = torch.rand(32, 64, generator=torch.Generator().manual_seed(5)) > 0.5
    differ = masked(mask, directions()) != mask[cells(directions(), 32)]
    assert differ.float().mean() < 1e-3, "but on edges between cells"
