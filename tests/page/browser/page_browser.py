"""Where Chromium is, how it is started for the page's tests, and a visit to the page."""

import time

CHROMIUM = "/usr/bin/chromium"
WINDOW = {"width": 1280, "height": 800}
FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


def until(page, expression, arg=None, timeout_s=6.0):
    """Wait for something in the page. Playwright's own waiting needs ``eval``, which the page's policy forbids."""
    end = time.monotonic() + timeout_s
    while not page.evaluate(expression, arg):
        assert time.monotonic() < end, f"never: {expression}"
        time.sleep(0.03)


THREE_FRAMES = """() => new Promise((done) => {
  const wait = (left) => (left ? requestAnimationFrame(() => wait(left - 1)) : done());
  wait(3);
})"""


class Visit:
    """A page that is open, and what went wrong in it.

    Pages of the usual window share a context, and so the browser's cache of the page's modules.
    """

    _shared = None

    def __init__(self, browser, address, **context):
        if Visit._shared is None:
            Visit._shared = browser.new_context(viewport=WINDOW)
        self.context = browser.new_context(**{"viewport": WINDOW, **context}) if context else Visit._shared
        self.page = self.context.new_page()
        self.problems, self.hosts = [], set()
        self.page.on("pageerror", lambda error: self.problems.append(str(error)))
        self.page.on("console", lambda message: message.type in {"error", "warning"} and self._note(message.text))
        self.page.on("request", lambda request: self.hosts.add(request.url.split("/")[2]))
        self.page.goto(address)
        until(self.page, "window.skyless?.state.connection.phase === 'open'")
        self.page.evaluate(THREE_FRAMES)  # the map is fitted to the site in the frame after its message

    def close(self):
        """End the visit, without a trace in the next one."""
        if self.context is not Visit._shared:
            self.context.close()
        else:
            self.page.evaluate("localStorage.clear(), sessionStorage.clear()")
            self.page.close()

    def _note(self, text):
        self.problems.append(text)

    def position(self, tag, tracks="live"):
        """Where the page draws a tag now."""
        return self.page.evaluate(
            """([tag, tracks]) => {
              const row = new Float64Array(16);
              return skyless[tracks].all.get(tag)?.at(skyless.shown_s(), row) ? [row[0], row[1]] : null;
            }""",
            [tag, tracks],
        )

    def at(self, x_m, y_m):
        """Pixel of a place of the site, from the window's upper left corner."""
        return self.page.evaluate(
            """async ([x, y]) => {
              const view = await import("/page/map/view.js");
              const box = document.getElementById("canvas").getBoundingClientRect();
              return [box.left + view.px(x), box.top + view.py(y)];
            }""",
            [x_m, y_m],
        )
