"""The picture of a replay is one, whatever the rows."""

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from matplotlib.image import imread

from skyless.cli.common import write_picture
from skyless.research.replays.plot import track_figure

pytestmark = pytest.mark.site


def draw(path, rows, title):
    write_picture(path, track_figure(rows, title))


def rows(count, *, truth):
    random = np.random.default_rng(4)
    times_s = np.linspace(3.0, 9.0, count)
    places = np.stack([np.cos(times_s), np.sin(times_s), 0 * times_s + 1.0], axis=1)
    fixes = places + random.normal(0.0, 0.05, places.shape)
    return np.column_stack([times_s, fixes, places if truth else np.full(places.shape, np.nan), 0 * fixes + 0.05])


@pytest.mark.parametrize(("count", "truth"), [(500, True), (500, False), (1, True), (1, False), (2, True)])
def test_a_png_has_a_size_and_something_in_it(tmp_path, count, truth):
    path = tmp_path / "picture.png"
    draw(path, rows(count, truth=truth), "some fixes")
    pixels = imread(path)
    assert pixels.shape[0] > 600
    assert pixels.shape[1] > 800
    assert 0.005 < np.mean(np.any(pixels[..., :3] < 0.9, axis=-1)) < 0.5  # ink on paper
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.statistical
def test_an_svg_is_xml_and_a_pdf_is_a_pdf(tmp_path):
    draw(tmp_path / "picture.svg", rows(50, truth=True), "a < b & c")
    assert ElementTree.parse(tmp_path / "picture.svg").getroot().tag.endswith("}svg")
    draw(tmp_path / "picture.pdf", rows(50, truth=True), "some fixes")
    data = (tmp_path / "picture.pdf").read_bytes()
    assert data.startswith(b"%PDF-")
    assert data.rstrip().endswith(b"%%EOF")


def test_without_a_fix_there_is_still_a_picture(tmp_path):
    draw(tmp_path / "picture.png", np.empty((0, 10)), "no fix")
    assert imread(tmp_path / "picture.png").ndim == 3


def test_an_old_picture_outlives_a_failure(tmp_path):
    path = tmp_path / "picture.xyz"
    path.write_text("old")
    with pytest.raises(ValueError, match="xyz"):
        draw(path, rows(5, truth=True), "some fixes")
    assert path.read_text() == "old"
