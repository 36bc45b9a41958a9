"""Late readings under clocks, which a node uses as if they had come in time."""

import numpy as np
import scipy.linalg

from netkf.algorithms.filter import Exchange, Message, Reading
from tests.theory.test_replay import LATE, SAMPLED, scenario_of

OFFSET = np.array([1e6, -3e5])


def estimate_after(scenario, late, offset):
    """The estimate of node 0, ``late`` seconds after node 1 has read at 0.1 + 0.2 s, at which the
    origin moves by ``offset``.
    """
    verbs, H, R = scenario.node_filter, np.array([[0.2, 1.0]]), np.array([[0.2]])
    hearer, sender = (
        verbs.init(scenario.models[i], *scenario.initial_estimate(i), scenario.node_infos[i])
        for i in (0, 1)
    )
    for gap in (0.1, 0.2):
        hearer, sender = verbs.predict(hearer, gap), verbs.predict(sender, gap)
    if offset.any():
        hearer, sender = verbs.shift(hearer, offset), verbs.shift(sender, offset)
    sender = verbs.update(sender, Reading(np.array([0.4]) + H @ offset, H, R, 0.3))
    sender, payload = verbs.emit(sender, Exchange(0.3, receivers=(0,)))
    hearer = verbs.predict(hearer, late)
    hearer = verbs.absorb(hearer, [Message(1, 0.5, payload, late)], Exchange(0.3 + late))
    return verbs.estimate(hearer)[0]


def test_a_late_reading_of_the_time_of_a_move_comes_after_it(tmp_path):
    scenario = scenario_of("intermittent", "readings", LATE, SAMPLED, tmp_path)
    # However the age is rounded: the time less the age is below that of the move for some.
    delays = np.round(np.random.default_rng(1).uniform(0.05, 0.9, 40), 12)
    now = 0.1 + 0.2
    assert ((now + delays) - delays < now).any()
    for late in delays.tolist():
        still = estimate_after(scenario, late, np.zeros(2))
        moved = estimate_after(scenario, late, OFFSET)
        back = scipy.linalg.expm(scenario.diffusion.A * late) @ OFFSET
        np.testing.assert_allclose(moved - back, still, rtol=0, atol=1e-8)
