"""Pages in a real browser: no error, nothing asked of a network, zoom, and pictures where no script runs."""

import base64
import io
import json
import os
import select
import shutil
import subprocess
import sys
import time

import numpy as np
import pytest
from matplotlib.image import imread

from casadi_engine.estimation.fit import Optimum
from casadi_engine.report import report

PROGRAM = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))),
    None,
)
# The browser reads from 3 and writes to 4; the two ends move out of the way first.
WIRED = """
import os, sys
ends = [os.dup2(int(end), 40 + k) for k, end in enumerate(sys.argv[1:3])]
for k, end in enumerate(ends):
    os.dup2(end, 3 + k)
os.execv(sys.argv[3], sys.argv[3:])
"""
PATIENCE = 30  # seconds for one answer on a busy machine


class Chromium:
    """One page in a browser without a window; a context manager.

    errors : texts of errors and warnings of scripts and of the page.  requested : URLs that were asked for
    """

    def __init__(self, folder, *, width=1100, height=900):
        self.errors, self.requested, self._events, self._left, self._number = [], [], [], b"", 0
        ours_in, theirs_out = os.pipe()
        theirs_in, ours_out = os.pipe()
        self._in, self._out = ours_in, ours_out

        options = (
            "--headless=new",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-dev-shm-usage",
            "--remote-debugging-pipe",
        )
        self._process = subprocess.Popen(
            [sys.executable, "-c", WIRED, str(theirs_in), str(theirs_out), PROGRAM, *options,
             f"--user-data-dir={folder}", "about:blank"],
            pass_fds=(theirs_in, theirs_out), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(theirs_in)
        os.close(theirs_out)
        self._session, self._scripts = None, True
        targets = self.call("Target.getTargets")["targetInfos"]
        page = next(one["targetId"] for one in targets if one["type"] == "page")
        self._session = self.call("Target.attachToTarget", targetId=page, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        self.size(width, height)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._process.terminate()
        self._process.wait(PATIENCE)
        os.close(self._in)
        os.close(self._out)

    def call(self, method, **given):
        """Ask for something and wait for the answer."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": given}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._read()
            if answer.get("id") == self._number:
                assert "error" not in answer, (method, answer["error"])
                return answer["result"]
            self._note(answer)

    def _read(self):
        end = time.monotonic() + PATIENCE
        while b"\0" not in self._left:
            assert select.select([self._in], [], [], max(0.0, end - time.monotonic()))[0], (
                "no answer of the browser"
            )
            more = os.read(self._in, 1 << 20)
            assert more, "the browser has ended"
            self._left += more
        message, _, self._left = self._left.partition(b"\0")
        return json.loads(message)

    def _note(self, event):
        given = event.get("params", {})
        match event.get("method"):
            case "Runtime.exceptionThrown":
                self.errors.append(json.dumps(given["exceptionDetails"])[:400])
            case "Runtime.consoleAPICalled":
                self.errors.append(json.dumps(given["args"])[:400])
            case "Log.entryAdded":
                self.errors.append(given["entry"]["text"])
            case "Network.requestWillBeSent":
                self.requested.append(given["request"]["url"])
            case method:
                self._events.append(method)

    def open(self, path):
        """Load a file and wait until it is shown."""
        self._events.clear()
        self.call("Page.navigate", url=path.resolve().as_uri())
        while "Page.loadEventFired" not in self._events:
            self._note(self._read())
        if self._scripts:
            self.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")

    def run(self, script):
        """The value of an expression in the page."""
        found = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def size(self, width, height):
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )

    def look(self, *, medium="", scheme="light", scripts=True):
        """Paper or screen, light or dark, with or without scripts; the latter holds from the next page on."""
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        self.call("Emulation.setEmulatedMedia", media=medium, features=features)
        self.call("Emulation.setScriptExecutionDisabled", value=not scripts)
        self._scripts = scripts

    def drag(self, start, end):
        """Press the left button at one place (x, y) of the window, and let it go at another."""
        for kind, (x, y) in (("Moved", start), ("Pressed", start), ("Moved", end), ("Released", end)):
            held = {} if kind == "Moved" else {"button": "left", "clickCount": 1}
            down = {"buttons": 1} if (kind != "Released" and (x, y) != start) or kind == "Pressed" else {}
            self.call("Input.dispatchMouseEvent", type=f"mouse{kind}", x=x, y=y, **held, **down)

    def double_click(self, place):
        for count in (1, 2):
            for kind in ("Pressed", "Released"):
                given = {"x": place[0], "y": place[1], "button": "left", "clickCount": count}
                self.call("Input.dispatchMouseEvent", type=f"mouse{kind}", **given)

    def box(self, element):
        """Left, top, width and height of an element, given by an expression, after scrolling to it."""
        self.run(f"void {element}.scrollIntoView({{block: 'center'}})")
        return self.run(f"(r => [r.left, r.top, r.width, r.height])({element}.getBoundingClientRect())")

    def picture(self, box):
        """Colours (height, width, 3) from 0 to 1 of a part of the window."""
        clip = dict(zip(("x", "y", "width", "height"), box, strict=True)) | {"scale": 1}
        clip["y"] += self.run("scrollY")
        data = self.call("Page.captureScreenshot", format="png", clip=clip)["data"]
        return imread(io.BytesIO(base64.b64decode(data)), format="png")[..., :3]


pytestmark = pytest.mark.skipif(
    PROGRAM is None, reason="no Chromium is installed (Debian: apt-get install chromium)"
)

WHOLE = "charts.map(u => [u.scales.x.min, u.scales.x.max])"
STARTS = (Optimum(1168.25, {}, 3, "converged"), Optimum(1300.0, {}, 1, "converged"))
SIMULATED = {"light": (0, 0x72, 0xB2), "dark": (0x4F, 0xB0, 0xEA)}


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Chromium(tmp_path_factory.mktemp("profile")) as made:
        yield made


@pytest.fixture
def page(browser):
    """The browser with nothing left of the test before."""
    browser.look()
    browser.size(1100, 900)
    browser.errors.clear()
    browser.requested.clear()
    return browser


@pytest.fixture
def opened(page, tmp_path, factory):
    page.open(report(factory.fit(samples=9000, predicted=True, optima=STARTS), tmp_path / "r.html"))
    return page


def has(colours, colour, share=1e-3):
    """Whether so large a share of a picture has a colour."""
    near = np.abs(colours - np.array(colour) / 255).max(axis=-1) < 0.06
    return near.mean() > share


@pytest.mark.parametrize("kind", ["fit", "validation", "repaired", "nothing_missing", "unnamed", "no_answer"])
def test_no_page_has_an_error_or_asks_a_network(page, tmp_path, request, kind):
    path = report(request.getfixturevalue(kind), tmp_path / "r.html")
    page.open(path)
    assert page.errors == []
    assert page.requested == [path.as_uri()]
    count = page.run("document.querySelectorAll('[data-chart]').length")
    assert count >= 1
    assert page.run("charts.length") == page.run("document.querySelectorAll('canvas').length") == count
    # nothing is wider than the window, so that nobody has to scroll sideways
    assert page.run("document.documentElement.scrollWidth <= innerWidth")


def test_a_drag_zooms_into_trace_and_residual_alike(opened, factory):
    before = opened.run(WHOLE)
    left, top, width, height = opened.box("charts[0].over")
    middle = top + height / 2
    opened.drag((left + 0.40 * width, middle), (left + 0.44 * width, middle))
    after = opened.run(WHOLE)
    linked = opened.run("charts.map(u => u.linked)")
    span = before[0][1] - before[0][0]
    expected = [before[0][0] + share * span for share in (0.40, 0.44)]
    for place, old, new in zip(linked, before, after, strict=True):
        assert new == pytest.approx(expected if place else old, abs=3e-3 * span)
    # the samples in the window are those of the record, and they fill the height
    trace = factory.fit(samples=9000, predicted=True).traces["misfire_1200rpm"]["omega"]
    inside = (trace.time >= after[0][0]) & (trace.time <= after[0][1])
    times = opened.run(
        "charts[0].data[0].filter(t => t >= charts[0].scales.x.min && t <= charts[0].scales.x.max)"
    )
    np.testing.assert_allclose(times, trace.time[inside], atol=1e-9)
    low, high = opened.run("[charts[0].scales.y.min, charts[0].scales.y.max]")
    ends = trace.measured[inside].min(), trace.measured[inside].max()
    assert low < ends[0] < ends[1] < high < low + 1.2 * (ends[1] - ends[0])
    # a step to the right by the width of the window, and back to the whole
    opened.run("document.querySelector('[title=later]').click()")
    moved = opened.run(WHOLE)[0]
    assert moved == pytest.approx([after[0][1], 2 * after[0][1] - after[0][0]])
    opened.double_click((left + width / 2, middle))
    assert opened.run(WHOLE) == before
    assert opened.run("document.querySelectorAll('.zoomed:not([hidden])').length") == 0
    # without a mouse: half of the width around its middle
    opened.run("document.querySelector('[title=closer]').click()")
    assert opened.run(WHOLE)[0] == pytest.approx([before[0][0] + share * span for share in (0.25, 0.75)])
    assert opened.errors == []


def test_the_pointer_reads_the_samples(opened, factory):
    left, top, width, height = opened.box("charts[0].over")
    place = (left + width / 2, top + height / 2)
    opened.drag(place, place)
    words = opened.run("document.querySelector('output').textContent")
    trace = factory.fit(samples=9000, predicted=True).traces["misfire_1200rpm"]["omega"]
    k = opened.run("charts[0].cursor.idx")
    assert f"time {trace.time[k]:.7g} s" in words
    assert f"measured {trace.measured[k]:.7g} rad/s" in words
    assert f"simulated {trace.simulated[k]:.7g} rad/s" in words


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_lines_are_drawn_in_the_colours_of_the_page(page, tmp_path, factory, scheme):
    page.look(scheme=scheme)
    page.open(report(factory.fit(samples=9000), tmp_path / "r.html"))
    colours = page.picture(page.box("charts[0].over"))
    assert has(colours, SIMULATED[scheme], 0.01)
    assert (np.median(colours) > 0.5) == (scheme == "light")


def test_the_colours_follow_a_change_of_the_scheme(opened):
    opened.look(scheme="dark")
    opened.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    assert has(opened.picture(opened.box("charts[0].over")), SIMULATED["dark"], 0.01)
    assert opened.errors == []


def test_a_narrow_window_has_narrow_charts(opened):
    opened.size(400, 900)
    opened.run("new Promise(done => setTimeout(done, 200))")
    assert opened.run("Math.max(...charts.map(u => u.width))") <= 400
    assert opened.run("document.documentElement.scrollWidth <= innerWidth")


@pytest.mark.parametrize("medium", ["", "print"])
def test_without_scripts_the_pictures_are_shown(page, tmp_path, factory, medium):
    page.look(scripts=False, medium=medium)
    page.open(report(factory.fit(samples=9000), tmp_path / "r.html"))
    assert page.run("document.querySelectorAll('canvas').length") == 0
    assert page.run("getComputedStyle(document.querySelector('.hint')).display") == "none"
    box = page.box("document.querySelector('[data-chart] > svg')")
    assert min(box[2:]) > 100
    assert has(page.picture(box), SIMULATED["light"], 0.01)


def test_paper_has_the_pictures_in_light_colours(opened):
    opened.look(medium="print", scheme="dark")
    assert opened.run("getComputedStyle(document.querySelector('.uplot')).display") == "none"
    box = opened.box("document.querySelector('[data-chart] > svg')")
    colours = opened.picture(box)
    assert has(colours, SIMULATED["light"], 0.01)
    assert np.median(colours) > 0.9
