"""The package's front door."""

import subprocess
import sys
from importlib.metadata import version

import numpy as np
import pytest

import skyless

pytestmark = pytest.mark.site


def test_every_name_opens():
    for name in skyless.__all__:
        assert getattr(skyless, name) is not None
    assert set(skyless.__all__) <= set(dir(skyless))


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        skyless.nothing  # noqa: B018


def test_its_version_is_the_installed_one():
    told = subprocess.check_output([sys.executable, "-m", "skyless.cli.main", "--version"], text=True).strip()
    assert skyless.__version__ == told == version("skyless")


def test_importing_it_is_light():
    script = "import sys, skyless; print({'numpy', 'scipy', 'msgspec', 'importlib.metadata'} & set(sys.modules))"
    assert subprocess.check_output([sys.executable, "-c", script], text=True).strip() == "set()"


def test_the_machines_classes_load_no_library_that_is_slow_to_load():
    heavy = "{'scipy', 'matplotlib', 'pandas'}"
    script = f"import sys; from skyless import Anchor, Fix, Receiver, Reception; print({heavy} & set(sys.modules))"
    assert subprocess.check_output([sys.executable, "-c", script], text=True).strip() == "set()"


def test_a_value_loads_no_estimator():
    """Value types and the interface of methods do not need what computes them."""
    modules = "fix, integrity"
    script = f"import sys; from skyless import Fix; from skyless.core import {modules}; print(*sys.modules)"
    loaded = subprocess.check_output([sys.executable, "-c", script], text=True).split()
    below = ("skyless.core.estimator", "skyless.core.tag", "skyless.run.masterless")
    assert [name for name in loaded if name.startswith(below)] == []


def test_a_robots_tag_loads_no_simulation():
    script = "import sys, skyless.run.tag; print(*sys.modules)"
    loaded = subprocess.check_output([sys.executable, "-c", script], text=True).split()
    assert [name for name in loaded if name.startswith("skyless.sim")] == []


def test_a_position_from_a_notebook():
    """Five anchors, ideal differences: the position comes back without a guess."""
    import numpy as np

    anchors_m = np.array([[0, 0, 0.5], [6, 0, 2.5], [6, 8, 0.5], [0, 8, 2.5], [3, 4, 3.0]], dtype=float)
    tag_m = np.array([2.0, 3.0, 1.2])
    ranges_m = np.linalg.norm(anchors_m - tag_m, axis=1)
    solution = skyless.locate(anchors_m, ranges_m[1:] - ranges_m[0], 0.01 * (np.eye(4) + 1.0))
    np.testing.assert_allclose(solution.position_m, tag_m, atol=1e-6)


@pytest.mark.parametrize(
    ("frame", "rx_ticks", "words"),
    [("abc", 1, "frame is 'abc'; it should be bytes"), (b"abc", 1.5, "rx_ticks is 1.5; it should be an integer")],
)
def test_what_is_no_frame_or_no_count_is_refused_with_what_is_wanted(frame, rx_ticks, words):
    with pytest.raises(TypeError, match=words):
        skyless.Reception(frame, rx_ticks)
    assert skyless.Reception(b"abc", np.int64(7)).rx_ticks == 7  # integers of NumPy are taken
