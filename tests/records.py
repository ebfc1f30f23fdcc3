"""Comparison of records of flown episodes."""

import numpy as np


def same_record(a, b):
    """Whether all that was measured is the same, bit for bit; times are not."""
    names = [name for name, value in vars(a).items() if isinstance(value, np.ndarray)]
    assert {"range_error_m", "range_crlb_m", "nees", "turns", "lost"} <= set(names)
    return all(np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True) for name in names)
