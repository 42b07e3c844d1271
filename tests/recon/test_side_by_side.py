"""Independent pieces of work on all cores."""

import threading

import pytest
import torch

from recon.side_by_side import side_by_side


def test_results_come_in_the_order_of_the_jobs_and_all_work_at_once(torch_threads):
    torch_threads(2)
    both = threading.Barrier(2, timeout=30)

    def work(job: int) -> tuple[int, int]:
        both.wait()  # which two that work one after the other would wait at for ever
        return job, torch.get_num_threads()

    assert list(side_by_side(work, range(6))) == [(job, 1) for job in range(6)]
    assert torch.get_num_threads() == 2


def test_what_fails_is_told_and_leaves_the_threads_as_they_were(torch_threads):
    torch_threads(2)

    def work(job: int) -> int:
        if job == 1:
            raise ValueError("not this one")
        return job

    done = side_by_side(work, range(100))
    assert next(done) == 0
    with pytest.raises(ValueError, match="not this one"):
        list(done)
    assert torch.get_num_threads() == 2
