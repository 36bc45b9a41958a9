"""When sensors sample a diffusion, and what they read."""

import functools

import numpy as np
import pytest

from netkf.core.clock import generate_ticks
from netkf.core.errors import ScenarioError
from netkf.network.clocks import Periodic, Poisson, Renewal
from netkf.plants.recorded import RecordedSensor
from netkf.plants.sampling import DrawnSamples, RecordedSampling
from netkf.plants.sensors import LinearSensor

H, R = np.array([[1.0, 0.0], [1.0, 1.0]]), np.array([[0.5, 0.1], [0.1, 0.3]])


def generator(seed, purpose):
    return np.random.default_rng([seed, len(purpose)])


@pytest.mark.parametrize(
    "clock",
    [
        Periodic(period=0.3),
        Periodic(period=0.3, phase=0.1, jitter=0.2),
        Periodic(period=0.3, phase="random"),
        Poisson(rate=4.0),
        Renewal("gamma", rate=3.0, shape=2.0),
        Renewal("uniform", low=0.0, high=0.5),
    ],
)
def test_samples_are_the_ticks_of_the_clock_below_the_horizon(clock):
    sensor = LinearSensor((3,), H, R, sampling=clock)
    times = sensor.sample_times(3, 0, functools.partial(generator, 1), 50.0)
    assert len(times) > 90
    assert (np.diff(times) > 0.0).all()
    assert times[0] > 0.0
    assert times[-1] < 50.0
    # One tick after the other.
    phase, random = (generator(1, name) for name in ("sampling phase", "sampling"))
    origin, now = clock.origin((3, 0), lambda: phase), 0.0
    for k, t in enumerate(times.tolist()):
        (now,) = clock.ticks((3, 0), origin, k, now, random, 1)
        assert now == t
    shorter = sensor.sample_times(3, 0, functools.partial(generator, 1), 20.0)
    np.testing.assert_array_equal(shorter, times[times < 20.0])


def test_the_first_sample_of_a_periodic_sensor_is_at_its_period():
    times = LinearSensor((0,), H, R, sampling=Periodic(period=0.5)).sample_times(
        0, 0, functools.partial(generator, 1), 2.0
    )
    np.testing.assert_array_equal(times, [0.5, 1.0, 1.5])


def test_increments_have_no_sample_times():
    for sampling in (None, "continuous"):
        sensor = LinearSensor((0,), H, R, sampling=sampling)
        assert sensor.sampling is None
    with pytest.raises(ScenarioError, match='sampling: must be "continuous" or a clock'):
        LinearSensor((0,), H, R, sampling="often")


def test_a_clock_that_does_not_advance_is_refused():
    class Stuck(Poisson):
        def ticks(self, entity, origin, index, now, random, count):
            return np.full(count, 1.5)

    with pytest.raises(ScenarioError, match=r"ticks of node .* must increase, after 1.5 s"):
        generate_ticks(Stuck(rate=1.0), (4,), None, None, 9.0)


def test_noise_is_the_cholesky_factor_times_normals_in_order():
    x = np.random.default_rng(2).standard_normal((100, 2))
    normals = np.random.default_rng(7).standard_normal((100, 2))
    expected = x @ H.T + normals @ np.linalg.cholesky(R).T
    one = DrawnSamples(H, R, np.random.default_rng(7))
    for k in (0, 1, 5, 64, 99):
        y, rows = one.reading(k, x[k])
        np.testing.assert_allclose(y, expected[k], rtol=1e-14)
        np.testing.assert_array_equal(rows, H)
    many = DrawnSamples(H, R, np.random.default_rng(7))
    for ks in ([0, 1, 2], [5], list(range(10, 100, 3))):
        y, rows = many.several(ks, x[ks])
        np.testing.assert_allclose(y, expected[ks], rtol=1e-14)
        assert rows.shape == (len(ks), 2, 2)


def test_recorded_sampling(tmp_path):
    (tmp_path / "s.csv").write_text("t,node\n0.5,3\n0.25,3\n0.5,3\n0.7,1\n9.0,3\n")
    clock = RecordedSampling(tmp_path / "s.csv")
    sensor = LinearSensor((1, 3, 5), H, R, sampling=clock)
    found = [sensor.sample_times(k, 0, functools.partial(generator, 1), 8.0) for k in (1, 3, 5)]
    assert [times.tolist() for times in found] == [[0.7], [0.25, 0.5], []]
    for row, words in (("0.0,1", "t must be above 0"), ("1.0,1.5", "node must hold integers")):
        (tmp_path / "s.csv").write_text(f"t,node\n{row}\n")
        with pytest.raises(ScenarioError, match=words):
            RecordedSampling(tmp_path / "s.csv")


def test_recorded_readings_at_their_own_times(tmp_path):
    (tmp_path / "r.csv").write_text(
        "t,node,y0,y1\n0.5,2,1.0,2.0\n0.25,2,3.0,4.0\n0.3,1,5.0,\n0.0,2,0.5,0.5\n"
    )
    sensor = RecordedSensor(path=tmp_path / "r.csv", H=H, R=R, nodes=(2,))
    times = sensor.sample_times(2, 0, None, 0.5)
    np.testing.assert_array_equal(times, [0.0, 0.25])
    path = sensor.samples(2, None, 0.5)
    y, rows = path.reading(1, np.full(2, np.nan))
    np.testing.assert_array_equal(y, [3.0, 4.0])
    np.testing.assert_array_equal(rows, H)
    y, rows = path.several([0, 2], np.full((2, 2), np.nan))
    np.testing.assert_array_equal(y, [[0.5, 0.5], [1.0, 2.0]])
    assert rows.shape == (2, 2, 2)
    with (tmp_path / "r.csv").open("a") as file:
        file.write("-0.5,2,1,1\n")
    with pytest.raises(ScenarioError, match="line 6: t must be at least 0"):
        RecordedSensor(path=tmp_path / "r.csv", H=H, R=R, nodes=(2,))


def test_recorded_readings_with_regressors(tmp_path):
    (tmp_path / "r.csv").write_text("t,node,y0,phi0,phi1\n0.5,2,1.0,7.0,8.0\n0.7,2,2.0,0.0,1.0\n")
    sensor = RecordedSensor(path=tmp_path / "r.csv", R=[[0.5]])
    path = sensor.samples(2, None, 1.0)
    y, rows = path.reading(0, None)
    np.testing.assert_array_equal(y, [1.0])
    np.testing.assert_array_equal(rows, [[7.0, 8.0]])
    y, rows = path.several([0, 1], None)
    np.testing.assert_array_equal(y, [[1.0], [2.0]])
    np.testing.assert_array_equal(rows, [[[7.0, 8.0]], [[0.0, 1.0]]])


def test_slots_without_a_row_have_no_reading(tmp_path):
    (tmp_path / "r.csv").write_text("t,node,y0,y1\n0.0,2,1.0,2.0\n2.0,2,3.0,4.0\n")
    path = RecordedSensor(path=tmp_path / "r.csv", H=H, R=R).slot_path(2, 1.0, None)
    assert path.reading(1, None).shape == (0,)
    assert path.matrix(1).shape == (0, 2)
    np.testing.assert_array_equal(path.reading(2, None), [3.0, 4.0])
    np.testing.assert_array_equal(path.several([0, 1], None)[1], [H, np.zeros((2, 2))])
