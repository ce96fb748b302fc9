"""A person sets up a site: axes, tapes, heights, a floor plan, and saves the survey of a made-up program."""

import io

import pytest
from page_browser import PHONE
from page_survey import TRUE, MadeUpSurvey
from PIL import Image

from support.waiting import came

pytestmark = pytest.mark.statistical

POSITIONS = """import("/page/map/survey.js").then(({ surveyPositions }) =>
  Object.fromEntries([...surveyPositions()].map(([id, { x_m, y_m }]) => [id, [x_m, y_m]])))"""
PLAN = "import('/page/survey/plan.js').then(({ plan }) => plan && [plan.x_m, plan.y_m, plan.width_m])"


class Site:
    """A site without any position, its survey program, and a page on it."""

    def __init__(self, serve, visit, survey=None, **context):
        self.survey = survey or MadeUpSurvey()
        self.server = serve(tags=0, zones=[], mode="free", placed=False, survey=self.survey)
        self.visit = visit(self.server, **context)
        self.page, self.until = self.visit.page, self.visit.until
        self.until("skyless.state.survey !== null")
        self.page.wait_for_selector("#panel-setup")

    def open(self, step):
        self.page.click(f"#step-{step} > summary")

    def click_anchor(self, anchor):
        """Click where the survey's picture shows an anchor."""
        x, y = self.visit.run("map/survey", "const { x, y } = survey.pixelOf(given); return [x, y];", anchor)
        box = self.page.locator("#canvas").bounding_box()
        self.page.mouse.click(box["x"] + x, box["y"] + y)

    def given(self, wanted):
        """Wait for facts of a kind; the last that were given."""
        return came(lambda: wanted(self.survey.facts) and self.survey.facts)

    def says(self, words):
        self.page.wait_for_selector(f"#verdict:has-text('{words}')")

    def positions_are(self, condition):
        self.until(f"{POSITIONS}.then((at) => {condition})")

    def plan_is(self, condition):
        """Wait for a plan of which this holds; there is none before its picture is read."""
        holds = f"(([x, y, width]) => {condition})"
        self.until(f"{PLAN}.then((plan) => plan !== null && {holds}(plan))")

    @property
    def plan(self):
        return self.page.evaluate(PLAN)


@pytest.fixture
def site(serve, visit):
    return lambda survey=None, **context: Site(serve, visit, survey, **context)


def picture():
    file = io.BytesIO()
    Image.new("RGB", (800, 600), (200, 30, 30)).save(file, "PNG")
    return {"name": "hall.png", "mimeType": "image/png", "buffer": file.getvalue()}


def test_anchors_appear_and_name_the_axes_by_clicks_on_the_map(site):
    here = site(MadeUpSurvey(heard=(1, 2), missing=(3, 4)))
    page = here.page
    assert page.locator("#tab-setup").get_attribute("aria-selected") == "true"
    page.locator("#waiting").wait_for(state="hidden")
    here.says("2 anchors have been received; too few pairs")
    rows = "[...document.querySelectorAll('#setup-anchors tbody tr')].map((row) => row.innerText.split('\\t'))"
    here.until(f"{rows}.length === 4")
    assert [row[-1] for row in page.evaluate(rows)] == ["not determined", "not determined"] + 2 * ["not received"]
    here.survey.heard, here.survey.missing = tuple(TRUE), ()
    here.until(f"{rows}.length === 6 && {rows}.every((row) => row.at(-1) === 'determined' && row[3] === '5.1 cm')")
    assert set(page.evaluate(POSITIONS)) == {str(n) for n in TRUE}
    seen = (
        "return [...survey.surveyPositions().values()].every((at) => view.isSeen(view.px(at.x_m), view.py(at.y_m), 0));"
    )
    assert here.visit.run("map/survey map/view", seen)
    here.open(2)
    page.click("#pick-axes")
    turned = "Math.hypot(...at[1]) < 1e-9 && at[3][1] ** 2 < 1e-9"
    for anchor, next_words in ((1, "on the x axis"), (3, "on the left"), (6, "")):
        here.click_anchor(anchor)
        here.until("words => document.getElementById('picking-help').textContent.includes(words)", next_words)
        if anchor == 3:  # the picture turns to the axes that are named by now
            here.positions_are(turned)
            here.visit.frames()
    facts = here.given(lambda facts: facts["gauge"] and facts["gauge"]["left"])
    assert facts["gauge"] == {"origin": 1, "x_axis": 3, "left": 6}
    here.positions_are(f"{turned} && at[6][1] > 5")
    page.wait_for_selector(".frame:has-text('Anchor 1 is the origin.')")
    assert "origin 1, x axis 3" in page.locator("#step-2 summary").inner_text()


def test_axes_are_named_by_lists_and_mirrored(site):
    here = site()
    page = here.page
    here.open(2)
    page.get_by_label("Origin", exact=True).select_option("4")
    page.wait_for_selector("text=anchor 1 is the farthest from anchor 4")
    page.get_by_label("On the x axis").select_option("6")
    here.given(lambda facts: facts["gauge"] == {"origin": 4, "x_axis": 6, "left": None})
    here.positions_are("Math.hypot(...at[4]) < 1e-9")
    before = page.evaluate(POSITIONS)
    page.locator("#mirror").press("Enter")
    gauge = here.given(lambda facts: facts["gauge"]["left"] is not None)["gauge"]
    here.positions_are(f"at[{gauge['left']}][1] > 0")
    side = 1 if gauge["origin"] == 4 else -1
    assert side * page.evaluate(POSITIONS)["2"][1] * before["2"][1] < 0 or gauge["origin"] == 6
    page.get_by_label("On the x axis").select_option("")
    here.given(lambda facts: facts["gauge"] is None)


def test_tapes_heights_and_points_are_typed_and_removed(site):
    here = site()
    page = here.page
    here.open(3)
    advice = page.locator("#tape-advice li >> nth=0")
    assert "Measure 1–4: 6.0 cm → 0.4 cm" in advice.inner_text()
    advice.get_by_role("button").click()
    distance = page.locator("#tape-form input")
    assert distance.evaluate("(input) => input === document.activeElement")
    for wrong in ("", "ten", "-3", "0,01"):
        distance.fill(wrong)
        distance.press("Enter")
        assert "number of metres" in page.locator("#tape-form .fault:visible").inner_text()
        assert distance.get_attribute("aria-invalid") == "true"
    assert not here.server.bodies["facts"]
    distance.fill("10,02 m")
    distance.press("Enter")
    tapes = here.given(lambda facts: facts["tapes"])["tapes"]
    assert tapes == [{"a": 1, "b": 4, "distance_m": 10.02, "std_m": 0.005}]
    page.wait_for_selector("#tapes li:has-text('1–4: 10.020 m')")
    here.says("to ±")
    assert "mistyped" not in page.locator("#tapes").inner_text()
    distance.fill("100.2")
    distance.press("Enter")
    page.wait_for_selector("#tapes li:has-text('The radio measures 10.10 m')")
    page.get_by_label("Remove the distance 1–4").click()
    here.given(lambda facts: facts["tapes"] == [])

    height = page.get_by_label("Anchor 2", exact=True)
    height.fill("2.5o")
    height.press("Enter")
    assert "“2.5o” should be a number of metres" in page.locator("#heights .fault:visible").inner_text()
    for words, heights_m in (("250 cm", {"2": 2.5}), ("", {})):
        height.fill(words)
        height.press("Enter")
        here.given(lambda facts, heights_m=heights_m: facts["heights_m"] == heights_m)
        here.until("z_m => skyless.state.survey.survey.anchors[1].z_m === z_m", heights_m.get("2", 0))
    form = page.locator("#point-form")
    form.get_by_label("Anchor").select_option("3")
    for label, value in (("x", "8.1"), ("y", "-0.1")):
        form.get_by_label(label, exact=True).fill(value)
    form.get_by_role("button").click()
    assert here.given(lambda facts: facts["points"])["points"] == {"3": [8.1, -0.1, None]}
    page.get_by_label("Remove the point of anchor 3").click()
    here.given(lambda facts: facts["points"] == {})
    page.get_by_label("Antenna delays", exact=True).select_option("0")
    here.given(lambda facts: facts["delay_std_m"] == 0)


def test_a_floor_plan_is_dragged_scaled_placed_and_saved_with_the_survey(site):
    here = site()
    survey, page, at = here.survey, here.page, here.visit.at
    survey.facts = {**survey.facts, "gauge": {"origin": 1, "x_axis": 3, "left": 6}}
    here.until("skyless.state.survey.facts.gauge !== null")
    here.open(4)
    page.set_input_files("#plan-file", {"name": "x.png", "mimeType": "image/png", "buffer": b"none"})
    page.wait_for_selector("#plan-fault:has-text('cannot be read as an image')")
    page.set_input_files("#plan-file", picture())
    here.plan_is("width > 0")
    page.wait_for_timeout(100)
    x, y, width = here.plan
    still = "import('/page/map/view.js').then(({ view }) => [view.x_m, view.y_m, view.scale])"
    view = page.evaluate(still)
    begin = at(x + width / 2, y + 1)
    here.visit.drag(begin, (begin[0] + 60, begin[1] - 40))
    moved = here.plan
    assert moved[:2] == pytest.approx([x + 60 / view[2], y + 40 / view[2]], abs=0.05)
    assert page.evaluate(still) == view
    page.focus("#canvas")
    page.keyboard.press("ArrowLeft")
    assert here.plan[0] == pytest.approx(moved[0] - 0.2)

    def click_points(*points):
        page.click("#plan-scale")
        left, bottom, width = here.plan
        for u, v in points:
            page.mouse.click(*at(left + u * width, bottom + v * 0.75 * width))

    click_points((0.1, 0.1), (0.9, 0.1))  # points of the image, where anchors 1 and 3 hang
    page.click("text=They are at two anchors")
    here.click_anchor(1)
    here.click_anchor(3)
    here.plan_is(f"Math.abs(width * 0.8 - {abs(TRUE[3] - TRUE[1])}) < 0.15")
    left, bottom, width = here.plan
    assert [left, bottom] == pytest.approx([-0.1 * width, -0.075 * width], abs=0.1)
    page.locator("#plan-turned").wait_for(state="hidden")
    came(lambda: survey.floor_plan == {"image": "", "x_m": left, "y_m": bottom, "width_m": width})

    click_points((0.25, 0.5), (0.75, 0.5))
    distance = page.get_by_label("Distance between the two points")
    distance.fill("wide")
    distance.press("Enter")
    assert "should be a number of metres" in page.locator("#plan-distance .fault").inner_text()
    distance.fill("10")
    distance.press("Enter")
    here.plan_is("Math.abs(width - 20) < 0.3")
    for label, value in (("Left edge, x", "-1.5"), ("Lower edge, y", "-2"), ("Width", "21")):
        field = page.get_by_label(label, exact=True)
        field.fill(value)
        field.press("Enter")
    assert here.plan == [-1.5, -2, 21]
    came(lambda: survey.floor_plan["width_m"] == 21)
    assert not here.server.bodies["floor_plan"], "it is stored when the survey is saved"

    here.open(6)
    here.until("serial => skyless.state.survey.serial === serial", survey.serial)
    here.until("document.getElementById('save-what').textContent.includes('hall.png')")
    page.click("#save")
    page.wait_for_selector("#save-state.good:has-text('/srv/hall/site.toml')")
    assert here.server.bodies["floor_plan"] == [picture()["buffer"]]
    here.open(4)
    page.click("text=Do without it")
    here.until(f"{PLAN}.then((plan) => plan === null)")
    here.visit.forgive()


def test_without_a_survey_program_the_page_shows_how_to_start_it(serve, visit):
    page = visit(serve(tags=0, zones=[], mode="free")).page
    page.click("#tab-setup")
    page.wait_for_selector("#verdict.note:has-text('start the survey program')")
    assert "skyless survey" in page.locator(".command code").inner_text()


UNFIT = """() => {
  const all = (selector) => [...document.querySelectorAll(selector)].filter((e) => e.checkVisibility());
  const small = (e) => {
    const box = e.getBoundingClientRect();
    return box.height < 36 || box.left < 0 || box.right > innerWidth;
  };
  const found = [
    ...all("html, body, #panels, .step-body").filter((e) => e.scrollWidth > e.clientWidth + 1),
    ...all("#panel-setup :is(button, select, summary, input:not([type=checkbox]))").filter(small),
  ];
  return found.map((e) => e.id || e.className || e.tagName);
}"""
"""What is wider than the phone, and what is too small for a finger."""


def test_every_step_fits_a_phone_and_a_floor_plan_is_dragged_by_a_finger(site):
    phone = {"viewport": PHONE, "has_touch": True, "is_mobile": True}
    here = site(MadeUpSurvey(missing=(7,), ambiguous=True), **phone)
    page = here.page
    for step in (1, 2, 3, 5, 6, 4):
        if step > 1:
            page.tap(f"#step-{step} > summary")
        if step == 4:
            page.set_input_files("#plan-file", picture())
            here.plan_is("width > 0")
        page.wait_for_timeout(80)
        assert page.evaluate(UNFIT) == [], step
    before = here.plan[0]
    box = page.locator("#canvas").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    wire = here.visit.context.new_cdp_session(page)
    for kind, right in (("Start", 0), *(("Move", 10 * step) for step in range(1, 6)), ("End", None)):
        points = [] if right is None else [{"x": x + right, "y": y}]
        wire.send("Input.dispatchTouchEvent", {"type": f"touch{kind}", "touchPoints": points})
    scale = here.visit.run("map/view", "return view.view.scale;")
    here.plan_is(f"Math.abs(x - {before} - {50 / scale}) < 0.05")
    page.click("#plan-scale")
    page.wait_for_timeout(500)  # the browser takes a tap sooner after a drag for the end of its fling
    page.tap("#picking-cancel")
    page.locator("#picking").wait_for(state="hidden")
