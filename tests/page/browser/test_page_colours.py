"""Colours of the page, from its files: a tag and a group have one hue in both themes."""

import math
import re
from importlib.resources import files

import numpy as np
import pytest
from test_page_map import oklab

BROWSER = files("skyless.page") / "browser"
TAGS = re.findall(r"--tag-\d: light-dark\((#\w+), (#\w+)\)", (BROWSER / "css" / "tokens.css").read_text("utf-8"))
GROUPS = re.search(r"const GROUPS = {(.*?)};", (BROWSER / "theme.js").read_text("utf-8"), re.DOTALL)[1]
GROUPS = list(zip(*(re.findall(r"#\w{6}", part) for part in GROUPS.split("dark:")), strict=True))


def hue(colour):
    _, a, b = oklab([int(colour[at : at + 2], 16) for at in (1, 3, 5)])
    assert math.hypot(a, b) > 0.08, f"{colour} is almost grey"
    return math.atan2(b, a)


@pytest.mark.parametrize(("pairs", "count"), [(TAGS, 8), (GROUPS, 24)])
def test_a_tag_and_a_group_have_one_hue_in_both_themes(pairs, count):
    assert len(pairs) == count
    turned = [math.remainder(hue(light) - hue(dark), math.tau) for light, dark in pairs]
    assert np.abs(turned).max() < math.radians(3.0)
    for theme in zip(*pairs, strict=True):
        assert len(set(theme)) == count
