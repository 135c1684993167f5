"""`acquire --live`: the page shows a running capture in a real browser, and its stop button does what Ctrl-C does.

With UMOV_SCREENSHOTS=FOLDER the picture of README.md is written there.
"""

import contextlib
import json
import os
import re
import resource
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path

import cv2
import numpy as np
import pytest

from processing.reports.design import style
from processing.storage.captures.capture import Capture

STATES = 1000


@pytest.fixture
def running(small_rig, configs, tmp_path):
    """A capture that is still running when the slowest browser stops it, with its live page.

    Yields process, address and folder.
    """
    rig = small_rig(clock_speed=1.5, rows=240, columns=320)
    plan = tmp_path / "long.yaml"
    text = (configs / "plans" / "drr.yaml").read_text()
    assert "states: 40" in text
    plan.write_text(text.replace("states: 40", f"states: {STATES}"))
    child = subprocess.Popen(
        [
            *(sys.executable, "-m", "acquisition.commands.application", "--live"),
            *("--plan", plan, "--rig", rig, "--out", tmp_path / "out"),
        ],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    url = None
    for line in child.stderr:
        match = re.search(r"live view: (http://\S+)", line)
        if match:
            url = match[1]
            break
    assert url, child.communicate()
    yield child, url, tmp_path / "out"
    child.kill()
    child.communicate()


def _get(url, path, host=None, method="GET", origin=None, data=None):
    base, query = url.split("/?")
    request = urllib.request.Request(base + path.replace("TOKEN", query), method=method, data=data)
    if host:
        request.add_header("Host", host)
    if origin:
        request.add_header("Origin", origin)
    with urllib.request.urlopen(request) as answer:
        return answer.status, answer.read()


@pytest.mark.long
def test_page_shows_the_capture_and_its_button_stops_it(running, browser):
    child, url, folder = running
    page = browser.new_page(viewport={"width": 390, "height": 844}, device_scale_factor=2, is_mobile=True)

    def wait_for(expression, page=page):
        # However long a busy machine takes for it; the limit of a test ends a hang.
        while not page.evaluate(expression):
            page.wait_for_timeout(100)

    page.goto(url)
    wait_for("document.getElementById('bar').value >= 6")
    assert page.evaluate("document.getElementById('simulated').hidden") is False
    assert "red_sphere" in page.evaluate("document.getElementById('title').textContent")
    assert "psg" in page.evaluate("document.getElementById('axes').textContent")
    wait_for("document.getElementById('frame').naturalWidth == 320")
    wait_for("document.getElementById('quick').naturalWidth == 320")
    # Readable on a phone: nothing is wider than the screen.
    assert page.evaluate("document.documentElement.scrollWidth <= 390")
    # The look of the application and the reports.
    assert style() in page.evaluate("document.querySelector('style').textContent")
    # Nothing came from elsewhere.
    resources = page.evaluate("performance.getEntriesByType('resource').map(e => e.name).join(' ')")
    assert all(name.startswith("http://127.0.0.1:") for name in resources.split())
    if shots := os.environ.get("UMOV_SCREENSHOTS"):
        wide = browser.new_page(viewport={"width": 1080, "height": 760})
        wide.goto(url)
        wait_for("document.getElementById('bar').value >= 25", wide)
        wide.wait_for_timeout(1000)
        wide.screenshot(path=Path(shots) / "live-view.png")
    # An answer that fails once must not take the button away.
    page.evaluate("document.getElementById('stop').disabled = true")
    wait_for("!document.getElementById('stop').disabled")
    page.evaluate("document.getElementById('stop').click()")
    out, err = child.communicate()
    assert child.returncode == 130, out + err
    (final,) = folder.glob("*.h5")
    with Capture(final) as capture:
        assert capture.status == "aborted"
        assert 6 <= len(capture.done) < STATES


def test_everything_needs_the_token_and_a_local_host(running):
    child, url, _ = running
    origin_url = url.split("/?")[0]
    for path, host, method, origin in (
        ("/stop", None, "POST", origin_url),
        ("/stop?token=wrong", None, "POST", origin_url),
        ("/stop?TOKEN", "evil.example", "POST", "http://evil.example"),
        ("/state?TOKEN", "evil.example", "GET", None),
        *(("/stop?TOKEN", None, "POST", origin) for origin in (None, "http://evil.example", "null", f"{origin_url}9")),
        ("/state?TOKEN", None, "GET", "http://evil.example"),
        *((path, None, "GET", None) for path in ("/", "/state", "/frame.png", "/quick.png", "/frame.png?token=")),
    ):
        with pytest.raises(urllib.error.HTTPError) as refused:
            _get(url, path, host, method, origin)
        assert refused.value.code == 403, path
        refused.value.close()
    assert json.loads(_get(url, "/state?TOKEN")[1])["simulated"] is True
    assert child.poll() is None


class Told:
    """A view that is told of frames without a run."""

    def __init__(self):
        from acquisition.screen.live_view import LiveView
        from acquisition.stop_request import StopRequest

        self.stop = StopRequest()
        self.view = LiveView(True, 64.0, 4095, self.stop)

    def state(self, number, rows=64, value=1000):
        from acquisition.screen.observer import StateReport
        from drivers.motion import Position

        pixels = np.full((rows, 80), value + number, np.uint16)
        positions = {"psg": Position(9.0 * number, number)}
        self.view.state_done(StateReport(number, "sample", positions, 0.01, 0.0, 0.0, 1e5, pixels))

    def wait_for(self, condition):
        while True:
            with contextlib.suppress(urllib.error.URLError, ConnectionError):
                state = json.loads(_get(self.view.url, "/state?TOKEN")[1])
                if condition(state):
                    return state
            time.sleep(0.02)


def test_many_browsers_that_do_not_read_are_refused_and_keep_nobody_out():
    """Two hundred of them, half of which never finish asking: the run tells on at once, one browser gets through."""
    page, stuck = Told(), []
    with page.view as view:
        view.run_started("many", None, 5, None)
        address = view.url.split("//")[1].split("/")[0].split(":")
        for k in range(200):
            link = socket.socket()
            link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1024)
            link.setblocking(False)
            link.connect_ex((address[0], int(address[1])))
            with contextlib.suppress(OSError):
                link.send(b"GET / HTTP/1.1\r\n" if k % 2 else b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n" * 20)
            stuck.append(link)
        for number in range(5):
            start_s = time.thread_time()
            page.state(number)
            # What the measuring thread itself does for the page, whatever the browsers do.
            assert time.thread_time() - start_s < 0.05
        last = page.wait_for(lambda state: state["done"] == 5)
        assert last["title"] == "many"
        for link in stuck:
            link.close()


def _drawn(png):
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)


def test_a_saturated_pixel_shows_red_even_where_thinning_leaves_it_out():
    from acquisition.screen.live_images import last_frame_png

    pixels = np.full((1000, 1200), 1000, np.uint16)
    grey = _drawn(last_frame_png(pixels, 64.0, 4095))
    pixels[500, 601] = 4095
    red = (_drawn(last_frame_png(pixels, 64.0, 4095)) != grey).any(axis=2)
    assert red.sum() == 1
    assert red[500 // 3, 601 // 3]


def test_the_quick_look_of_a_rotation_is_of_its_light_states_alone():
    """Against a second run that is shown the extremes only; darks and runs before leave no trace."""
    from acquisition.screen import live_process

    view = {"title": "x", "done": 1, "role": "sample", "mosaic": None}
    light = np.random.default_rng(3).integers(500, 4000, size=(12, 64, 80), dtype=np.uint16)
    full, extremes = (live_process.Shown(64.0, 4095, True) for _ in range(2))
    full.update(view | {"title": "before"}, np.full((32, 32), 4000, np.uint16))
    for done, frame in enumerate(light, start=1):
        full.update(view | {"done": done}, frame)
        assert (full.picture("quick.png") is None) == (done == 1)
    full.update(view | {"done": 13, "role": "dark"}, np.full((64, 80), 60, np.uint16))
    for done, frame in enumerate((light.min(axis=0), light.max(axis=0)), start=1):
        extremes.update(view | {"done": done}, frame)
    assert full.picture("quick.png") == extremes.picture("quick.png")
    low, high = light.min(axis=0) - 64.0, light.max(axis=0) - 64.0
    tones = (255 * (high - low) / (high + low)).astype(np.uint8)
    shown = _drawn(full.picture("quick.png")).astype(int)
    # The two tables differ in rounding.
    assert np.abs(shown - cv2.applyColorMap(tones, cv2.COLORMAP_VIRIDIS)).max() <= 1


def test_the_run_goes_on_when_the_process_of_the_page_is_killed():
    page = Told()
    with page.view as view:
        view.run_started("killed", None, 5, None)
        page.wait_for(lambda state: state.get("title") == "killed")
        view.process.kill()
        view.process.wait()
        for number in range(20):
            page.state(number)
    assert not page.stop.requested


def slow_connections(port, count):
    """Browsers without a token that begin a request and never end it; those given up connect again."""
    import selectors

    ended, connected = threading.Event(), threading.Event()

    def attack():
        links = []
        with selectors.DefaultSelector() as waiting:

            def connect():
                link = socket.socket()
                link.setblocking(False)
                link.connect_ex(("127.0.0.1", port))
                waiting.register(link, selectors.EVENT_WRITE)
                links.append(link)

            for _ in range(count):
                connect()
            while not ended.is_set():
                for key, _ in waiting.select(0.01):
                    link = key.fileobj
                    with contextlib.suppress(OSError):
                        link.send(b"GET /state HTTP/1.1\r\nHost: 127.0.0.1\r\n")
                    waiting.unregister(link)
                connected.set()
        for link in links:
            link.close()

    thread = threading.Thread(target=attack, daemon=True)
    thread.start()
    connected.wait()

    def end():
        ended.set()
        thread.join()

    return end


@pytest.mark.parametrize("body", [0, 64 << 20])
def test_stop_answers_under_a_thousand_slow_connections(body):
    """Of strangers without the token, with foreign hosts and origins beside them; a large body is not kept."""
    resource.setrlimit(resource.RLIMIT_NOFILE, (4096, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
    page = Told()
    with page.view as view:
        view.run_started("attacked", None, 5, None)
        page.wait_for(lambda state: state.get("title") == "attacked")
        base = view.url.split("/?")[0]
        end = slow_connections(int(base.rsplit(":", 1)[1]), 1000)
        for host, origin in (("evil.example", base), (None, "http://evil.example")):
            with pytest.raises(urllib.error.HTTPError) as refused:
                _get(view.url, "/stop?TOKEN", host, "POST", origin)
            refused.value.close()
        assert not page.stop.requested
        begin_s = time.monotonic()
        threading.Thread(target=_stop, args=(view.url, base, body), daemon=True).start()
        while not page.stop.requested and time.monotonic() - begin_s < 20:
            time.sleep(0.005)
        stopped_s = time.monotonic() - begin_s
        memory = int(re.search(r"VmHWM:\s+(\d+)", Path(f"/proc/{view.process.pid}/status").read_text())[1])
        end()
    print(f"stopped after {stopped_s:.3f} s; memory of the page {memory / 1024:.0f} MiB")
    assert page.stop.requested
    assert stopped_s < 1.0
    assert memory < 400 << 10


def _stop(url, base, body):
    with contextlib.suppress(OSError, urllib.error.URLError):
        _get(url, "/stop?TOKEN", method="POST", origin=base, data=bytes(body))
