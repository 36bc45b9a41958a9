"""check_intervals: ours miss as often as they say, and each way of being wrong is named."""

import pytest
import scipy.special

from netkf.studies import filter_values, targets
from netkf.testing import check_intervals, intervals


def test_intervals_of_comparisons_and_searches_miss_as_often_as_they_say():
    assert check_intervals() is None


def normal_quantile(freedom, probability):
    return scipy.special.ndtri(probability)


class OneSided:
    """Takes all of the level on each side."""

    @staticmethod
    def stdtrit(freedom, probability):
        return scipy.special.stdtrit(freedom, 2.0 * probability - 1.0)


class Normal:
    """Ignores how few runs there are."""

    stdtrit = staticmethod(normal_quantile)


class Scipy:
    """A module whose special functions are others."""

    def __init__(self, special):
        self.special = special


@pytest.mark.parametrize("special", [OneSided, Normal])
@pytest.mark.parametrize(
    ("module", "name"), [(filter_values, "compare_filters"), (targets, "size")]
)
def test_a_wrong_quantile_is_found(module, name, special, monkeypatch):
    monkeypatch.setattr(module, "scipy", Scipy(special))
    monkeypatch.setattr(intervals, "TRIALS", 1500)  # such errors show in fewer
    with pytest.raises(AssertionError, match=rf"{name} \w+: intervals must end (below|above)"):
        check_intervals()
