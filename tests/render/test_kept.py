"""What is kept beside a tensor is made again when anything that it was made from is another."""

import gc
import weakref

import torch

from render.kept import kept_beside


def counted():
    made = []

    @kept_beside
    def add(tensor: torch.Tensor, *more) -> torch.Tensor:
        made.append(tensor.shape)
        return sum(more, start=tensor + 0)

    return add, made


def test_the_same_tensor_is_looked_at_once():
    add, made = counted()
    tensor = torch.arange(3)
    assert add(tensor, 1) is add(tensor, 1) and len(made) == 1


def test_what_was_written_to_or_comes_with_something_else_is_looked_at_again():
    add, made = counted()
    tensor, other = torch.zeros(2), torch.ones(2)
    for change in (lambda: None, lambda: tensor.add_(1), lambda: other.add_(1), lambda: None):
        change()
        assert torch.equal(add(tensor, other), tensor + other)
    assert torch.equal(add(tensor, other.clone()), tensor + other)
    assert len(made) == 4 and add(tensor, 5)[0] == 6


def test_nothing_outlives_its_tensor():
    add, _ = counted()
    tensor = torch.zeros(2)
    kept = weakref.ref(add(tensor))
    del tensor
    gc.collect()
    assert kept() is None
