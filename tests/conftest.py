"""What every test starts from: the CPU, one thread of torch, fixed seeds, no display."""

import os
import random

os.environ["CUDA_VISIBLE_DEVICES"] = ""  # read when torch is imported; the tests are the same on every machine
os.environ["MPLBACKEND"] = "Agg"

import numpy as np
import pytest
import torch
from hypothesis import settings

# The first example of a test may compile, so no deadline. The same examples every time, except in `make fuzz`.
settings.register_profile("fuzz", deadline=None, derandomize=False, max_examples=1000, print_blob=True)
settings.register_profile("default", deadline=None, derandomize=True, database=None, print_blob=True)  # becomes the parent
settings.load_profile("default")


@pytest.fixture(autouse=True)
def same_start():
    """Sums come out the same on any number of cores, and global generators start from the same seed in every test."""
    torch.set_num_threads(1)
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002 - SB3's buffers draw from it
    torch.manual_seed(0)


def legends_cover_nothing(figure):
    """Assert that a figure's legends lie within it and outside of its axes."""
    figure.draw_without_rendering()
    assert not any(axes.get_legend() for axes in figure.axes)
    for legend in figure.legends:
        box = legend.get_window_extent()
        assert box.x0 >= -1 and box.x1 <= figure.bbox.width + 1, box
        assert not any(box.overlaps(axes.get_window_extent()) for axes in figure.axes)
