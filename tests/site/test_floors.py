"""Floors in a site's file."""

from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace

from skyless.core.errors import ConfigurationError
from skyless.core.site import FloorSite
from skyless.run.mqtt.messages import SiteMessage, read_message, site_message
from skyless.sim.lab import lab_site
from skyless.site.file.check import plan_files
from skyless.site.file.load import load_site
from skyless.site.file.template import site_template

PNG = b"\x89PNG\r\n\x1a\n" + bytes(4) + b"IHDR" + (9).to_bytes(4) + (7).to_bytes(4)
SITE = """
name = "House"
id = 3
master = 1
anchors = [{id = 1, x_m = 0, y_m = 0}, {id = 2, x_m = 9, y_m = 0}, {id = 3, x_m = 0, y_m = 9, z_m = 8}]
"""


def test_floors_are_written_to_a_site_file_and_travel_beside_the_site(tmp_path):
    file = tmp_path / "site.toml"
    floors = FloorSite(0, 0.0, "Ground"), FloorSite(1, 3.2, 'Ü "1"', "up.png", 24.0, -1.0, 2.0)
    (tmp_path / "up.png").write_bytes(PNG)
    site = replace(lab_site(), floors=floors)
    file.write_text(site_template(site), encoding="utf-8")
    assert load_site(file) == site
    assert plan_files(site, file) == {1: tmp_path / "up.png"}
    assert plan_files(lab_site(), file) == {}
    payload = msgspec.json.encode(site_message(site, simulated=True, unix_s=1.0))
    assert msgspec.json.decode(payload)["site"].keys().isdisjoint({"floors", "outline_m"})
    assert read_message(payload, SiteMessage).whole_site == site


@pytest.mark.parametrize(
    ("floors", "key", "right"),
    [
        ("[[floors]]\nnumber = 1\nlow_m = 0\n[[floors]]\nnumber = 1\nlow_m = 3\n", "floors[1].number", "above 1"),
        ("[[floors]]\nnumber = 1\nlow_m = 2\n[[floors]]\nnumber = 2\nlow_m = 2\n", "floors[1].low_m", "above 2"),
        ("[[floors]]\nnumber = 1\n", "floors[0].low_m", "a number of metres"),
        ("[[floors]]\nnumber = 1.5\nlow_m = 2\n", "floors[0].number", "a whole number"),
        ('[[floors]]\nnumber = 1\nlow_m = 2\nimage = "a.png"\n', "floors[0].width_m", "belong together"),
        ('[[floors]]\nnumber = 1\nlow_m = 2\nimage = "a.png"\nwidth_m = 3\n', "floors[0].image", "a file that can be"),
        ("[[floors]]\nnumber = 1\nlow_m = 2\nlevel = 3\n", "floors[0].level", "left out"),
    ],
)
def test_wrong_floors_are_named(tmp_path, floors, key, right):
    file = tmp_path / "site.toml"
    file.write_text(SITE + floors)
    with pytest.raises(ConfigurationError) as refused:
        load_site(file)
    assert refused.value.key == key
    assert right in refused.value.expected
    assert Path(str(refused.value).split(":")[0]).name == "site.toml"
