"""Two engines, one scenario: the same events to the bit, the same states to 1e-10."""

import numpy as np

import netkf
from netkf.engines.simpy.engine import SimpyEngine


def assert_agree(scenario, replica=0, engine="compiled"):
    """Run an engine and SimPy; returns the run of the former."""
    fast = netkf.simulate(scenario, replica=replica, engine=engine)
    slow = netkf.simulate(scenario, replica=replica, engine=SimpyEngine())
    assert (fast.engine, slow.engine) == (engine, "simpy")
    assert netkf.first_difference(fast, slow) is None
    assert fast.fingerprint == slow.fingerprint
    assert fast.status == slow.status
    for name in ("times", "x", "xhat", "P", "error"):
        one, other = getattr(fast, name), getattr(slow, name)
        # An estimate of 0 is rounding of what it was computed from, which is as large as x.
        size = max(_largest(other), _largest(slow.x) if name in ("xhat", "error") else 0.0)
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-10 * size, err_msg=name)
    assert fast.exact_errors == slow.exact_errors
    assert fast.sums.keys() == slow.sums.keys()
    for name, pair in slow.sums.items():
        np.testing.assert_allclose(fast.sums[name], pair, rtol=1e-10)
    return fast


def assert_blocks_do_not_matter(scenario, monkeypatch):
    """A run in slots is the same if fewer slots come in one call of a kernel."""
    whole = netkf.simulate(scenario, engine="compiled")
    monkeypatch.setattr("netkf.engines.compiled.slot_setup.BLOCK_BYTES", 1 << 12)
    parts = netkf.simulate(scenario, engine="compiled")
    assert parts.fingerprint == whole.fingerprint
    np.testing.assert_array_equal(parts.P, whole.P)
    np.testing.assert_array_equal(parts.error, whole.error)


def _largest(values):
    return np.nanmax(np.abs(values), initial=0.0, where=np.isfinite(values))
