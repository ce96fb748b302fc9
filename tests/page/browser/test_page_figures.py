"""What the page computes by itself, against NumPy and closed forms."""

import math

import numpy as np
import pytest

pytestmark = pytest.mark.statistical


@pytest.fixture
def page(serve, visit):
    return visit(serve(tags=0)).page


def test_positions_between_fixes_lie_on_straight_lines(page):
    times = np.cumsum([0.0, 0.1, 0.13, 0.08, 0.4, 2.0, 0.1])
    rows = [["t", t**2, -t, *[0.0] * 11, float(t), 0.0] for t in times]
    for row in rows:
        assert len(row) == 16
    asked = [0.05, 0.2, 0.5, 0.71, 1.5, 2.7, 2.75, 2.81, 9.0]
    got = page.evaluate(
        """async ([rows, asked]) => {
          const { Track, TIME } = await import("/page/tracks.js");
          const track = new Track("t");
          for (const row of rows) track.push([...row.slice(0, 14), row[13], row[14], row[15]]);
          const out = new Float64Array(16);
          return asked.map((time) => (track.at(time, out), [out[0], out[1]]));
        }""",
        [rows, asked],
    )
    expected = np.interp(asked, times, times**2)
    silent = (np.array(asked) > times[4]) & (np.array(asked) < times[5])
    expected[silent] = times[4] ** 2  # nothing is interpolated over a gap
    np.testing.assert_allclose([x for x, _ in got], expected, atol=1e-12)


def test_a_track_keeps_the_newest_states(page):
    kept = page.evaluate("""async () => {
      const { Track, TIME } = await import("/page/tracks.js");
      const track = new Track("t");
      for (let n = 0; n < 5000; n++) {
        const row = Array(17).fill(n);
        row[TIME + 1] = n / 10;
        track.push(row);
        if (n % 7 === 0) track.push(row);
      }
      return [track.count, track.value(0, TIME), track.lastTime, track.find(499.85)];
    }""")
    assert kept == [2048, 295.2, 499.9, 2046]


SIGMAS_95 = math.sqrt(-2.0 * math.log(0.05))


def test_ellipses_have_the_axes_of_the_covariance(page):
    draw = np.random.default_rng(4)
    for factor in draw.normal(size=(20, 2, 2)):
        covariance = factor @ factor.T
        (xx, xy), (_, yy) = covariance.tolist()
        major, minor, angle = page.evaluate(
            "async (given) => (await import('/page/map/view.js')).halfAxes(...given)", [xx, xy, yy]
        )
        major, minor = major / SIGMAS_95, minor / SIGMAS_95
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        np.testing.assert_allclose(turn @ np.diag([major**2, minor**2]) @ turn.T, covariance, rtol=1e-4, atol=1e-4)


def test_offsets_continue_over_the_wrap_of_the_counter(page):
    wrap_s = 2**40 / 63.8976e9
    given = [(n + 1.0, ((8.602 + 3e-6 * n + wrap_s / 2) % wrap_s) - wrap_s / 2) for n in range(1500)]
    got = page.evaluate(
        """async (given) => {
          const { addHealth, anchorHistory } = await import("/page/history.js");
          const add = (health) => addHealth([health], [], new Set([99]), new Set());
          const more = { rate_ppm: 3, offset_std_m: 0.01 };
          for (const [unix_s, offset_s] of given) add({ anchor: 99, unix_s, offset_s, ...more });
          return anchorHistory.get(99).offset_us;
        }""",
        given,
    )
    np.testing.assert_allclose(got, 3.0 * np.arange(1200, 1500), atol=1e-3)


def test_no_line_of_a_chart_crosses_a_restart_a_silence_or_another_master(page):
    given = [(1, 10, 1, 0.5), (2, 11, 1, 0.5), (20, 1, 1, 7.0), (21, 2, 1, 7.0), (22, 3, 2, 1.0), (23, 4, 2, 1.1)]
    offsets, rates = page.evaluate(
        """async (given) => {
          const { addHealth, anchorHistory } = await import("/page/history.js");
          const add = (health) => addHealth([health], [], new Set([99]), new Set());
          for (const [unix_s, uptime_s, master, offset_s] of given)
            add({ anchor: 99, role: "anchor", unix_s, uptime_s, master, offset_s, rate_ppm: 3 });
          const clock = { anchor: 99, role: "master", master: 99, unix_s: 24, uptime_s: 5, offset_s: 0, rate_ppm: 0 };
          add({ ...clock, offset_std_m: 0 });
          const { offset_us, rate_ppm } = anchorHistory.get(99);
          return [offset_us, rate_ppm];
        }""",
        given,
    )
    assert rates == [3, 3, None, 3, 3, 3, 3, None]
    assert offsets[:5] == [None] * 5
    np.testing.assert_allclose(offsets[5:7], [0.0, 1e5], atol=1e-6)


def test_a_number_that_is_rounded_to_zero_has_no_sign(page):
    written = """async () => {
      const { metres, number } = await import("/page/format.js");
      return [metres(-0.001), metres(-0.01), metres(-0.2, 0), number(-0.00001, 4, "s"), number(-1.5, 1)];
    }"""
    assert page.evaluate(written) == ["0.00", "−0.01", "0", "0.0000\u00a0s", "−1.5"]


def test_zones_hold_what_a_polygon_holds(page):
    path = pytest.importorskip("matplotlib.path")
    polygon = [[0, 0], [6, 0], [6, 5], [3, 2], [0, 5]]
    points = np.random.default_rng(5).uniform(-1, 7, (200, 2)).tolist()
    got = page.evaluate(
        """async ([polygon, points]) => {
          const { inside } = await import("/page/map/zones.js");
          return points.map(([x, y]) => inside(polygon, x, y));
        }""",
        [polygon, points],
    )
    assert got == path.Path([*polygon, polygon[0]]).contains_points(points).tolist()
