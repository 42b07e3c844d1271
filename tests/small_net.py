"""A small network for the enhancer's tests."""

import torch

from enhance.network.net import Net, NetConfig

SMALL = NetConfig(width=24, blocks=2, heads=3, half=8, quarter=8, eighth=16, looks=8)


def stirred(seed=0):
    """A network whose last layers do something, as after training."""
    torch.manual_seed(seed)
    net = Net(SMALL).eval()
    for layer in (net.decoder.pixels, net.denoise):
        torch.nn.init.normal_(layer.weight, std=0.05)
    return net
