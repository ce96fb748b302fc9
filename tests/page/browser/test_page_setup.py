"""The guided set-up in a real browser, against a made-up survey program."""

import io
import time

import pytest
from page_browser import THREE_FRAMES, until
from page_survey import TRUE, MadeUpSurvey
from PIL import Image

pytestmark = pytest.mark.statistical

SIDEWAYS = """[...document.querySelectorAll("html, body, #panels, .step-body")]
  .filter((e) => e.scrollWidth > e.clientWidth + 1).map((e) => e.id || e.className || e.tagName)"""
VERDICT = "document.getElementById('verdict').textContent.includes"
POSITIONS = """async () => {
  const { surveyPositions } = await import("/page/map/survey.js");
  return Object.fromEntries([...surveyPositions()].map(([id, { x_m, y_m }]) => [id, [x_m, y_m]]));
}"""


class Site:
    """A site without any position, its survey program, and a page on it."""

    def __init__(self, serve, visit, survey=None, **context):
        self.survey = survey or MadeUpSurvey()
        self.server = serve(tags=0, zones=(), mode="free", placed=False, survey=self.survey)
        self.visit = visit(self.server, **context)
        self.page = self.visit.page
        until(self.page, "skyless.state.survey !== null")
        self.page.wait_for_selector("#panel-setup")

    def open(self, step):
        self.page.click(f"#step-{step} > summary")

    def pixel(self, anchor):
        """Pixel of an anchor of the survey's picture, from the window's upper left corner."""
        return self.page.evaluate(
            """async (id) => {
              const { pixelOf } = await import("/page/map/survey.js");
              const box = document.getElementById("canvas").getBoundingClientRect();
              const { x, y } = pixelOf(id);
              return [box.left + x, box.top + y];
            }""",
            anchor,
        )

    def click_anchor(self, anchor):
        self.page.mouse.click(*self.pixel(anchor))

    def given(self, wanted):
        """Wait for facts of a kind; the last that were given."""
        end = time.monotonic() + 6
        while not (self.survey.given and wanted(self.survey.given[-1]["facts"])):
            assert time.monotonic() < end, self.survey.given[-1:]
            time.sleep(0.02)
        return self.survey.given[-1]["facts"]

    def says(self, words):
        until(self.page, f"(words) => {VERDICT}(words)", words, timeout_s=9.0)


@pytest.fixture
def site(serve, visit):
    return lambda survey=None, **context: Site(serve, visit, survey, **context)


def test_the_tab_opens_where_nothing_has_a_position(site):
    here = site()
    assert here.page.locator("#tab-setup").get_attribute("aria-selected") == "true"
    until(here.page, "document.querySelectorAll('#setup-anchors tbody tr').length === 6")
    here.page.locator("#waiting").wait_for(state="hidden")
    assert set(here.page.evaluate(POSITIONS)) == {str(n) for n in TRUE}


def test_anchors_appear_and_the_picture_grows(site):
    here = site(MadeUpSurvey(heard=(1, 2), missing=(3, 4)))
    here.says("2 anchors have been received; too few pairs")
    rows = "[...document.querySelectorAll('#setup-anchors tbody tr')].map((row) => row.innerText.split('\\t'))"
    until(here.page, f"{rows}.length === 4")
    assert [row[-1] for row in here.page.evaluate(rows)] == ["not determined", "not determined"] + 2 * ["not received"]
    tray = "import('/page/map/survey.js').then(({ pixelOf }) => [pixelOf(1), pixelOf(2)].every(Boolean))"
    until(here.page, tray)
    here.survey.heard, here.survey.missing = (1, 2, 3, 4), ()
    until(here.page, f"{rows}.every((row) => row.at(-1) === 'determined' && row[3] === '5.1 cm')")
    assert set(here.page.evaluate(POSITIONS)) == {"1", "2", "3", "4"}
    factor = "import('/page/map/survey.js').then(({ ellipseFactor }) => ellipseFactor())"
    assert here.page.evaluate(factor) >= 1
    seen = here.page.evaluate("""async () => {
      const { surveyPositions } = await import("/page/map/survey.js");
      const view = await import("/page/map/view.js");
      return [...surveyPositions().values()].every(({ x_m, y_m }) => {
        const [x, y] = [view.px(x_m), view.py(y_m)];
        return x > 0 && x < view.view.width && y > 0 && y < view.view.height;
      });
    }""")
    assert seen


def test_the_picture_shows_late_pairs_ghosts_and_what_is_not_determined(site):
    survey = MadeUpSurvey()
    here = site(survey)
    drawn = """async () => {
      const { drawSurvey } = await import("/page/map/survey.js");
      const context = document.createElement("canvas").getContext("2d");
      const seen = { lines: 0, dashed: 0, ellipses: 0, squares: 0, words: [] };
      let dash = [];
      const wrap = (name, more) => {
        const own = context[name].bind(context);
        context[name] = (...args) => (more(...args), own(...args));
      };
      wrap("setLineDash", (list) => (dash = list));
      wrap("lineTo", () => dash.length ? seen.dashed++ : seen.lines++);
      wrap("ellipse", () => seen.ellipses++);
      wrap("strokeRect", () => seen.squares++);
      wrap("fillText", (words) => seen.words.push(words));
      drawSurvey(context);
      return seen;
    }"""
    until(here.page, f"({drawn})().then((seen) => seen.ellipses === 6)")
    seen = here.page.evaluate(drawn)
    assert (seen["lines"], seen["dashed"], seen["squares"]) == (15, 0, 0)
    survey.excluded, survey.ambiguous, survey.undetermined = {(1, 4)}, True, (6,)
    until(here.page, "skyless.state.survey.survey.ambiguities.length === 1")
    seen = here.page.evaluate(drawn)
    assert seen["lines"] == 14 - 5  # pairs of the anchor without a position are not drawn
    assert (seen["dashed"], seen["ellipses"], seen["squares"]) == (2, 5, 1)  # one late pair, one way to a ghost
    assert seen["words"].count("4?") == 2
    assert {"6", "Without a position yet:"} <= set(seen["words"])
    assert any("larger" in words for words in seen["words"])


def test_axes_are_named_by_clicks_on_the_map(site):
    here = site()
    here.open(2)
    here.page.click("#pick-axes")
    for anchor, next_words in ((1, "on the x axis"), (3, "on the left"), (6, "")):
        here.click_anchor(anchor)
        until(here.page, "(words) => document.getElementById('picking-help').textContent.includes(words)", next_words)
        if anchor == 3:  # the picture turns to the axes that are named by now
            until(here.page, f"({POSITIONS})().then((at) => Math.hypot(...at[1]) < 1e-9 && at[3][1] ** 2 < 1e-9)")
            here.page.evaluate(THREE_FRAMES)
    assert here.given(lambda facts: facts["gauge"] and facts["gauge"]["left"])["gauge"] == {
        "origin": 1, "x_axis": 3, "left": 6,
    }  # fmt: skip
    until(
        here.page, f"({POSITIONS})().then((at) => Math.hypot(...at[1]) < 1e-9 && at[3][1] ** 2 < 1e-9 && at[6][1] > 5)"
    )
    here.page.wait_for_selector(".frame:has-text('Anchor 1 is the origin.')")
    assert "origin 1, x axis 3" in here.page.locator("#step-2 summary").inner_text()


def test_axes_are_named_by_lists_and_mirrored(site):
    here = site()
    here.open(2)
    here.page.get_by_label("Origin", exact=True).select_option("4")
    here.page.wait_for_selector("text=anchor 1 is the farthest from anchor 4")
    here.page.get_by_label("On the x axis").select_option("6")
    here.given(lambda facts: facts["gauge"] == {"origin": 4, "x_axis": 6, "left": None})
    until(here.page, f"({POSITIONS})().then((at) => Math.hypot(...at[4]) < 1e-9)")
    before = here.page.evaluate(POSITIONS)
    here.page.click("#mirror")
    gauge = here.given(lambda facts: facts["gauge"]["left"] is not None)["gauge"]
    side = 1 if gauge["origin"] == 4 else -1
    until(here.page, f"({POSITIONS})().then((at) => at[{gauge['left']}][1] > 0)")
    after = here.page.evaluate(POSITIONS)
    assert side * after["2"][1] * before["2"][1] < 0 or gauge["origin"] == 6
    here.page.get_by_label("On the x axis").select_option("")
    here.given(lambda facts: facts["gauge"] is None)


def test_a_tape_is_asked_for_and_typed(site):
    here = site()
    here.open(3)
    advice = here.page.locator("#tape-advice li >> nth=0")
    assert "Measure 1–4: 6.0 cm → 0.4 cm" in advice.inner_text()
    advice.get_by_role("button").click()
    distance = here.page.locator("#tape-form input")
    assert distance.evaluate("(input) => input === document.activeElement")
    for wrong in ("", "ten", "-3", "0,01"):
        distance.fill(wrong)
        distance.press("Enter")
        fault = here.page.locator("#tape-form .fault:visible")
        assert "number of metres" in fault.inner_text()
        assert distance.get_attribute("aria-invalid") == "true"
    assert here.survey.given == []
    distance.fill("10,02 m")
    distance.press("Enter")
    facts = here.given(lambda facts: facts["tapes"])
    assert facts["tapes"] == [{"a": 1, "b": 4, "distance_m": 10.02, "std_m": 0.005}]
    here.page.wait_for_selector("#tapes li:has-text('1–4: 10.020 m')")
    here.says("to ±")
    assert "mistyped" not in here.page.locator("#tapes").inner_text()
    distance.fill("100.2")
    distance.press("Enter")
    here.page.wait_for_selector("#tapes li:has-text('The radio measures 10.10 m')")
    here.page.get_by_label("Remove the distance 1–4").click()
    here.given(lambda facts: facts["tapes"] == [])


def test_heights_and_points_are_typed_and_removed(site):
    here = site()
    here.open(3)
    height = here.page.get_by_label("Anchor 2", exact=True)
    height.fill("2.5o")
    height.press("Enter")
    assert "“2.5o” should be a number of metres" in here.page.locator("#heights .fault:visible").inner_text()
    height.fill("250 cm")
    height.press("Enter")
    assert here.given(lambda facts: facts["heights_m"])["heights_m"] == {"2": 2.5}
    until(here.page, "skyless.state.survey.survey.anchors[1].z_m === 2.5")
    height.fill("")
    height.press("Enter")
    here.given(lambda facts: facts["heights_m"] == {})
    form = here.page.locator("#point-form")
    form.get_by_label("Anchor").select_option("3")
    for label, value in (("x", "8.1"), ("y", "-0.1")):
        form.get_by_label(label, exact=True).fill(value)
    form.get_by_role("button").click()
    assert here.given(lambda facts: facts["points"])["points"] == {"3": [8.1, -0.1, None]}
    here.page.get_by_label("Remove the point of anchor 3").click()
    here.given(lambda facts: facts["points"] == {})
    here.page.get_by_label("Antenna delays", exact=True).select_option("0")
    here.given(lambda facts: facts["delay_std_m"] == 0)


def picture():
    file = io.BytesIO()
    Image.new("RGB", (800, 600), (200, 30, 30)).save(file, "PNG")
    return {"name": "hall.png", "mimeType": "image/png", "buffer": file.getvalue()}


ON_THE_FLOOR = "no heights are given: all anchors are taken to be on the floor."
PLAN = "import('/page/survey/plan.js').then(({ plan }) => plan && [plan.x_m, plan.y_m, plan.width_m])"


def test_a_floor_plan_is_dragged_and_scaled_by_two_anchors(site):
    here = site()
    survey, page = here.survey, here.page
    survey.facts = {**survey.facts, "gauge": {"origin": 1, "x_axis": 3, "left": 6}}
    until(page, "skyless.state.survey.facts.gauge !== null")
    here.open(4)
    page.set_input_files("#plan-file", {"name": "x.gif", "mimeType": "image/gif", "buffer": b"GIF89a"})
    page.wait_for_selector("#plan-fault:has-text('should be a PNG or JPEG')")
    page.set_input_files("#plan-file", {"name": "x.png", "mimeType": "image/png", "buffer": b"none"})
    page.wait_for_selector("#plan-fault:has-text('cannot be read as an image')")
    assert "at most 8 MB" in page.evaluate("""async () => {
      const { readImage } = await import("/page/survey/plan.js");
      const big = new File([new Uint8Array(8_000_001)], "x.png", { type: "image/png" });
      return readImage(big).catch((error) => error.message);
    }""")
    page.set_input_files("#plan-file", picture())
    until(page, PLAN)
    page.wait_for_timeout(100)
    x, y, width = page.evaluate(PLAN)
    view = page.evaluate("import('/page/map/view.js').then(({ view }) => [view.x_m, view.y_m, view.scale])")
    start = here.visit.at(x + width / 2, y + 1)
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(start[0] + 60, start[1] - 40, steps=5)
    page.mouse.up()
    moved = page.evaluate(PLAN)
    assert abs(moved[0] - x - 60 / view[2]) < 0.05
    assert abs(moved[1] - y - 40 / view[2]) < 0.05
    assert page.evaluate("import('/page/map/view.js').then(({ view }) => [view.x_m, view.y_m, view.scale])") == view
    page.focus("#canvas")
    page.keyboard.press("ArrowLeft")
    assert abs(page.evaluate(PLAN)[0] - moved[0] + 0.2) < 1e-6

    page.click("#plan-scale")
    left, bottom, width = page.evaluate(PLAN)
    height = width * 0.75
    for u, v in ((0.1, 0.1), (0.9, 0.1)):  # points of the image, where anchors 1 and 3 hang
        page.mouse.click(*here.visit.at(left + u * width, bottom + v * height))
    page.click("text=They are at two anchors")
    here.click_anchor(1)
    here.click_anchor(3)
    apart = abs(TRUE[3] - TRUE[1])
    until(page, f"{PLAN}.then(([x, y, w]) => Math.abs(w * 0.8 - {apart}) < 0.15)")
    left, bottom, width = page.evaluate(PLAN)
    assert abs(left + 0.1 * width) < 0.1
    assert abs(bottom + 0.1 * 0.75 * width) < 0.1
    assert not page.locator("#plan-turned").is_visible()
    end = time.monotonic() + 5
    while survey.floor_plan is None or abs(survey.floor_plan["width_m"] - width) > 1e-6:
        assert time.monotonic() < end, survey.floor_plan
        time.sleep(0.05)
    assert survey.floor_plan == {"image": "", "x_m": left, "y_m": bottom, "width_m": width}
    assert survey.image is None  # it is stored when the survey is saved
    here.visit.problems.clear()  # the browser's own line about the image that cannot be read


def test_a_floor_plan_is_scaled_by_a_typed_distance_and_placed_by_figures(site):
    here = site()
    page = here.page
    here.open(4)
    page.set_input_files("#plan-file", picture())
    until(page, PLAN)
    page.click("#plan-scale")
    left, bottom, width = page.evaluate(PLAN)
    for u in (0.25, 0.75):
        page.mouse.click(*here.visit.at(left + u * width, bottom + 0.4 * width))
    distance = page.get_by_label("Distance between the two points")
    distance.fill("wide")
    distance.press("Enter")
    assert "should be a number of metres" in page.locator("#plan-distance .fault").inner_text()
    distance.fill("10")
    distance.press("Enter")
    until(page, f"{PLAN}.then(([x, y, width]) => Math.abs(width - 20) < 0.3)")
    for label, value in (("Left edge, x", "-1.5"), ("Lower edge, y", "-2"), ("Width", "21")):
        field = page.get_by_label(label, exact=True)
        field.fill(value)
        field.press("Enter")
    assert page.evaluate(PLAN) == [-1.5, -2, 21]
    page.click("text=Do without it")
    until(page, f"{PLAN}.then((plan) => plan === null)")


def test_the_reasons_are_listed_and_the_verdict_is_good_only_where_nothing_speaks_against_it(site):
    survey = MadeUpSurvey()
    here = site(survey)
    here.says("All 6 anchors are determined and checked")
    good = "document.getElementById('verdict').classList.contains('good')"
    assert here.page.evaluate(good)
    here.open(5)
    here.page.wait_for_selector("#why:has-text('no other result fits')")
    for change, words in (
        ({"notes": ("Point of anchor 3 does not fit.",)}, "Point of anchor 3 does not fit."),
        ({"missing": (7,)}, "1 anchor has not been received: 7."),
        ({"assumed_heights": ON_THE_FLOOR}, "No heights are given: all anchors are taken to be on the floor."),
        ({"unchecked": "Nothing checks this survey."}, "Nothing checks this survey."),
        ({"ambiguous": True}, "1 other result fits"),
        ({"undetermined": (5,)}, "Anchor 5 is not determined."),
        ({"error": "the disk is full"}, "The disk is full."),
        ({"state": "no data"}, "No data."),
    ):
        for name, value in change.items():
            setattr(survey, name, value)
        here.says(words)
        assert not here.page.evaluate(good)
    shown = here.page.locator("#why").inner_text()
    for words in (
        "does not fit",
        "Nothing checks",
        "on the floor",
        "further to the right",
        "It is linked to one other anchor only.",
    ):
        assert words in shown


def test_a_site_in_use_that_nobody_sets_up_has_no_fault(serve, visit):
    """What another survey would leave open is none, until somebody begins one; saving it asks all the same."""
    survey = MadeUpSurvey()
    survey.unchecked, survey.undetermined = "Nothing checks this survey.", (6,)
    page = visit(serve(tags=0, zones=(), mode="free", survey=survey)).page
    until(page, "skyless.state.survey !== null")
    page.click("#tab-setup")
    page.wait_for_selector("#verdict.note:has-text('In use. All anchors have positions.')")
    page.click("#step-5 > summary")
    page.wait_for_selector("#why:has-text('Nothing checks this survey.')")
    page.click("#step-6 > summary")
    page.wait_for_selector("#save-warning:has-text('Anchor 6 is not determined.')")
    assert page.locator("#save").is_disabled()
    page.click("#step-2 > summary")
    page.get_by_label("Origin", exact=True).select_option("1")
    page.get_by_label("On the x axis").select_option("3")
    page.wait_for_selector("#verdict.bad:has-text('Anchor 6 is not determined.')")


def test_a_site_in_use_without_a_survey_program_has_no_fault(serve, visit):
    page = visit(serve(tags=0, zones=(), mode="free")).page
    page.click("#tab-setup")
    page.wait_for_selector("#verdict.note:has-text('start the survey program')")
    assert "skyless survey" in page.locator(".command code").inner_text()


def test_without_heights_the_set_up_is_amber_and_saving_asks(site):
    survey = MadeUpSurvey()
    survey.assumed_heights = ON_THE_FLOOR
    here = site(survey)
    page = here.page
    here.says("all anchors are taken to be on the floor")
    assert page.locator("#verdict").get_attribute("class") == "verdict warn"
    assert "heights are missing" in page.locator("#step-3 > summary").inner_text()
    here.open(6)
    page.wait_for_selector("#save-warning:has-text('on the floor')")
    assert page.locator("#save").is_disabled()
    page.check("#save-sure")
    page.click("#save")
    page.wait_for_selector("#save-state.good")
    assert len(survey.saves) == 1


def test_an_old_message_is_reported_as_old(site):
    survey = MadeUpSurvey()
    here = site(survey)
    here.says("determined and checked")
    survey.silent = True
    here.server.send({**survey.message(), "age_s": 4.0})
    here.says("has sent nothing for")
    assert here.page.locator("#verdict").get_attribute("class") == "verdict bad"
    here.server.send({**survey.message(), "age_s": 3600.0})  # one that the broker had kept
    here.says("3600 s")
    here.open(6)
    here.page.wait_for_selector("#save-what li")
    assert here.page.locator("#save").is_disabled()


def test_without_a_survey_program_the_page_shows_how_to_start_it(serve, visit):
    server = serve(tags=0, zones=(), mode="free", placed=False)
    page = visit(server).page
    page.wait_for_selector("#verdict:has-text('No survey program')")
    server.send({"type": "mqtt", "connected": True, "broker": "mqtt://hall:1883"})
    page.wait_for_selector(".command code:text-is('skyless survey --mqtt mqtt://hall:1883 --site site.toml --serve')")
    page.evaluate("skyless.state.site.name = 'hall'")  # a site is named after its file
    page.wait_for_selector(".command code:text-is('skyless survey --mqtt mqtt://hall:1883 --site hall.toml --serve')")
    server.send({"type": "mqtt", "connected": False, "broker": "mqtt://hall:1883"})
    page.wait_for_selector("#verdict:has-text('No broker')")


SURVEYED = """async () => {
  const { unix_s } = skyless.state.survey;
  while (skyless.state.survey.unix_s === unix_s) await new Promise((done) => setTimeout(done, 30));
  await new Promise((done) => setTimeout(done, 300)); // the tab shows it
}"""


def test_the_survey_is_saved(site):
    survey = MadeUpSurvey()
    here = site(survey)
    page = here.page
    here.open(4)
    page.set_input_files("#plan-file", picture())
    until(page, PLAN)
    until(page, "skyless.state.survey.serial === 2")  # where the plan lies has been sent, which makes a new result
    here.open(6)
    what = page.locator("#save-what")
    until(page, "document.getElementById('save-what').textContent.includes('hall.png')")
    assert "6 anchors" in what.inner_text()
    assert "/srv/hall/site.toml" in what.inner_text()
    page.click("#save")
    page.wait_for_selector("#save-state.good:has-text('/srv/hall/site.toml')")
    assert len(survey.saves) == 1
    assert survey.image == picture()["buffer"]
    state = page.locator("#save-state")
    survey.saved_serial, survey.saved_unix_s = survey.serial, 1_780_000_000.0
    survey.cleared, survey.ignores_saves = False, True
    until(page, "skyless.state.survey.saved_unix_s === 1780000000 && skyless.state.survey.survey !== null")
    page.click("#save")  # the same result again; the answer to the first request is no answer to this one
    until(page, "document.getElementById('save-state').textContent === 'Saving …'")
    page.evaluate(SURVEYED)
    assert state.inner_text() == "Saving …"
    survey.saved_unix_s += 3661
    page.wait_for_selector("#save-state.good")
    at = page.evaluate("new Date(1780003661e3).toLocaleTimeString('en-GB')")
    assert state.inner_text() == f"Saved at {at} in /srv/hall/site.toml, and sent to the anchors."


def test_a_weak_result_is_saved_only_on_purpose_and_a_failure_is_shown(site):
    survey = MadeUpSurvey()
    survey.unchecked = "Nothing checks this survey."
    survey.refuse_save = "site.toml cannot be written: the disk is full"
    here = site(survey)
    page = here.page
    here.open(6)
    page.wait_for_selector("#save-warning:has-text('Nothing checks this survey.')")
    assert page.locator("#save").is_disabled()
    page.check("#save-sure")
    page.click("#save")
    page.wait_for_selector("#save-state.bad:has-text('the disk is full')")
    assert survey.saved_serial is None


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_every_step_fits_a_phone_and_is_legible(site, theme):
    survey = MadeUpSurvey(missing=(7,))
    survey.ambiguous = True
    phone = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
    here = site(survey, color_scheme=theme, **phone)
    page = here.page
    for step in range(1, 7):
        if step > 1:
            page.tap(f"#step-{step} > summary")
        if step == 4:
            page.set_input_files("#plan-file", picture())
            until(page, PLAN)
        page.wait_for_timeout(80)
        assert page.evaluate(SIDEWAYS) == [], step
        assert page.evaluate(LOW_CONTRAST) == [], step
        small = page.evaluate(SMALL)
        assert small == [], step


LOW_CONTRAST = """() => {
  const rgb = (css) => {
    const canvas = Object.assign(document.createElement("canvas"), { width: 1, height: 1 });
    const context = canvas.getContext("2d", { willReadFrequently: true });
    context.fillStyle = css;
    context.fillRect(0, 0, 1, 1);
    return [...context.getImageData(0, 0, 1, 1).data];
  };
  const light = ([r, g, b]) => {
    const part = (v) => ((v /= 255) <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
    return 0.2126 * part(r) + 0.7152 * part(g) + 0.0722 * part(b);
  };
  const behind = (element) => {
    for (let e = element; e; e = e.parentElement) {
      const colour = rgb(getComputedStyle(e).backgroundColor);
      if (colour[3] > 250) return colour;
    }
    return [255, 255, 255, 255];
  };
  const found = new Set();
  for (const e of document.querySelectorAll("#panel-setup *, #picking *")) {
    const own = [...e.childNodes].some((node) => node.nodeType === 3 && node.textContent.trim());
    if (!own || !e.checkVisibility() || e.disabled) continue;
    const [a, b] = [light(rgb(getComputedStyle(e).color)), light(behind(e))].sort((x, y) => y - x);
    const ratio = (a + 0.05) / (b + 0.05);
    if (ratio < 4.5) found.add(`${e.className || e.tagName} ${ratio.toFixed(1)}`);
  }
  return [...found];
}"""
SMALL = """() => [...document.querySelectorAll("#panel-setup :is(button, select, summary, input:not([type=checkbox]))")]
  .filter((e) => e.checkVisibility()).map((e) => [e.id || e.textContent, e.getBoundingClientRect()])
  .filter(([, box]) => box.height < 36 || box.left < 0 || box.right > innerWidth).map(([name]) => name)"""


def test_a_floor_plan_is_dragged_by_a_finger(site):
    phone = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
    here = site(None, **phone)
    page = here.page
    page.tap("#step-4 > summary")
    page.set_input_files("#plan-file", picture())
    until(page, PLAN)
    page.wait_for_timeout(100)
    before = page.evaluate(PLAN)
    box = page.locator("#canvas").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    wire = here.visit.context.new_cdp_session(page)
    touch = lambda kind, points: wire.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})  # noqa: E731
    touch("touchStart", [{"x": x, "y": y}])
    for step in range(1, 6):
        touch("touchMove", [{"x": x + 10 * step, "y": y}])
    touch("touchEnd", [])
    scale = page.evaluate("import('/page/map/view.js').then(({ view }) => view.scale)")
    until(page, f"{PLAN}.then(([x]) => Math.abs(x - {before[0]} - {50 / scale}) < 0.05)")
    page.wait_for_timeout(500)  # the browser takes a tap sooner after a drag for the end of its fling
    page.tap("#picking-cancel")
    page.locator("#picking").wait_for(state="hidden")
