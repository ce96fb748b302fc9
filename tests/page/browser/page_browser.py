"""Where Chromium is, how it is started for the page's tests, and a visit to the page."""

import time
from pathlib import Path

CHROMIUM = "/usr/bin/chromium"
WINDOW, PHONE = {"width": 1280, "height": 800}, {"width": 390, "height": 844}
FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


LIMIT_S = 60.0
"""A busy machine may take seconds for anything; only what never comes is an error."""


def until(page, expression, arg=None):
    """Wait for something in the page. Playwright's own waiting needs ``eval``, which the page's policy forbids."""
    end = time.monotonic() + LIMIT_S
    while not page.evaluate(expression, arg):
        assert time.monotonic() < end, f"never: {expression}"
        time.sleep(0.03)


class Visit:
    """A page that is open, and what went wrong in it.

    Pages of the usual window share a context, and so the browser's cache of the page's modules.
    """

    _shared = None

    def __init__(self, browser, address, **context):
        if Visit._shared is None:
            Visit._shared = browser.new_context(viewport=WINDOW)
        self.context = browser.new_context(**{"viewport": WINDOW, **context}) if context else Visit._shared
        self.page, self.host = self.context.new_page(), address.split("/")[2]
        self.problems, self.hosts = [], set()
        self.page.on("pageerror", lambda error: self.problems.append(str(error)))
        self.page.on("console", lambda message: message.type in {"error", "warning"} and self._note(message.text))
        self.page.on("request", lambda request: self.hosts.add(request.url.split("/")[2]))
        self.page.goto(address)
        self.until("window.skyless?.state.connection.phase === 'open'")
        self.frames()  # the map is fitted to the site in the frame after its message

    def close(self):
        """End the visit, without a trace in the next one."""
        if self.context is not Visit._shared:
            self.context.close()
        else:
            self.page.evaluate("localStorage.clear(), sessionStorage.clear()")
            self.page.close()

    def _note(self, text):
        self.problems.append(text)

    def forgive(self):
        """Forget the browser's own lines about what the server refused, and about pixels that are read."""
        own = ("Failed to load resource", "WebSocket connection", "getImageData")
        self.problems[:] = [text for text in self.problems if not any(words in text for words in own)]

    def until(self, expression, arg=None):
        """Wait for something in the page."""
        until(self.page, expression, arg)

    def run(self, modules, body, given=None):
        """What statements of JavaScript return that use modules of the page by their last names."""
        imports = (f"const {name.split('/')[-1]} = await import('/page/{name}.js'); " for name in modules.split())
        return self.page.evaluate(f"async (given) => {{ {''.join(imports)} {body} }}", given)

    def frames(self):
        """Wait for three frames."""
        self.page.evaluate("""() => new Promise((done) => {
          const wait = (left) => (left ? requestAnimationFrame(() => wait(left - 1)) : done());
          wait(3);
        })""")

    def texts(self, selector):
        """The words of all elements of a kind."""
        return self.page.locator(selector).all_inner_texts()

    def saved(self, selector):
        """Name and content of the file that a click saves."""
        with self.page.expect_download() as found:
            self.page.click(selector)
        return found.value.suggested_filename, Path(found.value.path()).read_bytes()

    def position(self, tag, tracks="live"):
        """Where the page draws a tag now."""
        return self.page.evaluate(
            """([tag, tracks]) => {
              const row = new Float64Array(24);
              return skyless[tracks].all.get(tag)?.at(skyless.shown_s(), row) ? [row[0], row[1]] : null;
            }""",
            [tag, tracks],
        )

    def at(self, x_m, y_m):
        """Pixel of a place of the site, from the window's upper left corner."""
        box = self.page.locator("#canvas").bounding_box()
        x, y = self.run("map/view", "return [view.px(given[0]), view.py(given[1])];", [x_m, y_m])
        return box["x"] + x, box["y"] + y

    def drag(self, begin, end):
        """Drag from one pixel to another."""
        mouse = self.page.mouse
        mouse.move(*begin)
        mouse.down()
        mouse.move(*end, steps=4)
        mouse.up()
