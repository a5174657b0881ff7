"""Fixtures of the browser tests: Chromium with a record of all requests, and viewers with their readers."""

import importlib.util
import threading
import time
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest
from waiting import wait_until

HERE = Path(__file__).parent
#: viser's answer to a drag in the picture, to a mouse; Chromium lets it do so for fingers only.
HARMLESS = "Unable to preventDefault inside passive event listener"
#: How long something may take on a machine that others keep busy, s: what comes, comes much sooner.
PATIENCE = 300.0
#: Of the virtual measurement, N.
NOISE = 0.02


#: What all tests of pages share, to be closed after the last of them.
SHARED = ExitStack()


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item, nextitem):
    """Stop Playwright after the browser tests, because its running event loop would disturb other tests."""
    if nextitem is None or HERE not in nextitem.path.parents:
        SHARED.close()


def pytest_sessionfinish():
    """Release the shared resources also after an interrupted run."""
    SHARED.close()


@pytest.fixture(scope="session")
def chromium(root):
    """Module `docs/chromium.py`, which also makes the screenshots of the documentation."""
    spec = importlib.util.spec_from_file_location("docs_chromium", root / "docs" / "chromium.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def browser(chromium):
    """One Chromium for all tests; each test has separate pages that share no data."""
    if chromium.chromium_path() is None:
        pytest.skip("tests the page in Chromium, a system package that pip cannot install; PATH has neither "
                    "chromium nor chromium-browser. Debian: apt install chromium fonts-dejavu-core. .ci/run does so")
    return SHARED.enter_context(chromium.chromium())


@dataclass
class Traffic:
    """Requests and errors of a page."""

    urls: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)

    def watch(self, page):
        page.on("request", lambda request: self.urls.append(request.url))
        page.on("requestfailed", lambda request: self.failed.append(f"{request.url}: {request.failure}"))
        page.on("response", lambda reply: reply.ok or self.failed.append(f"{reply.url}: {reply.status}"))
        page.on("websocket", self._watch_socket)
        page.on("console", lambda message: message.type == "error" and HARMLESS not in message.text
                and self.errors.append(message.text))
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        return page

    def _watch_socket(self, websocket):
        self.urls.append(websocket.url)
        websocket.on("socketerror", lambda error: self.failed.append(f"{websocket.url}: {error}"))

    def foreign(self, server):
        """Requested addresses outside the server, without blob and data URLs, which cause no request."""
        place = server.local_url.removeprefix("http://")
        own = tuple(f"{scheme}://{place}/" for scheme in ("http", "ws", "blob:http"))
        return [url for url in self.urls if not url.startswith(own) and not url.startswith("data:")]


@contextmanager
def pages_of(browser, chromium):
    """Yield the function that `open_page` describes."""
    opened = []

    def open_one(server, *, width=1000, height=700, scheme="light", triangles=0, pixel_ratio=0.2):
        context = browser.new_context(viewport={"width": width, "height": height}, color_scheme=scheme,
                                      accept_downloads=True)
        traffic = Traffic()
        page = traffic.watch(context.new_page())
        page.set_default_timeout(PATIENCE * 1e3)
        opened.append((server, context, page, traffic))
        chromium.open_viewer(page, server.make_page_address(), triangles=triangles, pixel_ratio=pixel_ratio)
        return page

    open_one.traffic = lambda page: next(traffic for _, _, one, traffic in opened if one is page)
    yield open_one
    found = [(traffic.foreign(server), traffic.failed, traffic.errors) for server, _, _, traffic in opened]
    for _, context, _, _ in opened:
        context.close()
    assert found == [([], [], [])] * len(opened)


@pytest.fixture
def open_page(browser, chromium):
    """Open a page of a server: ``open_page(server, width=, height=, scheme=, triangles=)`` -> Playwright's page.

    Each page has its own cookies and storage. The teardown checks that no page has requested anything from another
    server, had a failed request, or had a script error. ``open_page.traffic(page)`` returns the `Traffic` of a page.
    """
    with pages_of(browser, chromium) as open_one:
        yield open_one


class Shown:
    """Running viewer: the page, with its session in a thread.

    Attributes:
        session: Session of the viewer.
        page: Page of the viewer.
        frame: Newest frame.
        scene: First scene, which `begin_again` restores; its measurement is the model with sensor noise.
        folder: Folder of material files, which contains ``softer.material.json``.
    """

    def __init__(self, scene, folder: Path, patience: float = 0.05):
        from haptics.loop.loop import LoopSettings
        from scenes.viewer.page import Page
        from scenes.viewer.session import Session

        self.scene, self.folder = scene, folder
        self.session = Session(scene, settings=LoopSettings(
            period=4e-3, snapshot_rate=30.0, real_time=False, patience=patience))
        self.page = None
        try:
            self.frame = self.session.update_and_make_frame()
            self.page = Page(self.session, self.frame, folder, port=0, low_graphics=True)
        except BaseException:
            self.close()
            raise
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self.session.run, args=(self, self._stop))
        self._thread.start()

    def show(self, frame) -> None:
        self.page.show(frame)
        self.frame = frame

    def close(self) -> None:
        if self.page is not None:
            self._stop.set()
            self._thread.join()
            self.page.close()
        self.session.close()

    @property
    def local_url(self) -> str:
        return self.page.server.local_url

    def make_page_address(self) -> str:
        return self.page.server.make_page_address()

    def ask(self, command: str, **values) -> None:
        """Post a command to the session and wait for its execution, like another browser."""
        answered = threading.Event()
        said = []
        self.session.post(command, reply=lambda problem: (said.append(problem), answered.set()), **values)
        assert answered.wait(PATIENCE) and said == [None], said

    def begin_again(self) -> None:
        """Restore `scene`, with the tool at the undeformed surface."""
        first, scene = self.scene, self.session.scene
        if scene.experiment != first.experiment:
            self.ask("use_scene", name=first.kind.name, tool=first.experiment.tool, friction=first.experiment.friction)
        if scene.material != first.material or scene.source != first.source:
            self.ask("use_material", material=first.material, source=first.source)
        wait_until(lambda: self.session.simulation.phase.name in ("RUNNING", "PAUSED"), lambda: self.frame.message,
                   PATIENCE)
        self.ask("reset")


@pytest.fixture(scope="session")
def shown(browser, tmp_path_factory):
    """Viewer with a needle scene, shared by all tests of the page."""
    import tissue_sim as ts
    from scenes.commands.shared.experiment_flags import load_material_or_study_silicone
    from scenes.viewer.measurement import build_measurement_from_replicates
    from scenes.viewer.scene import Scene
    from tissue_sim.experiment.kinds.standard_tests import NEEDLE
    from tissue_sim.material.file import MaterialFile
    from tissue_sim.parameters import with_values

    experiment = NEEDLE.experiment(specimen=ts.Specimen(radius=0.04, height=0.07), protocol=ts.Protocol.ramp(5e-3, 21))
    scene = Scene(NEEDLE, experiment, load_material_or_study_silicone(None))
    true = ts.simulate(scene.model, resolution="fast")
    replicates = [ts.Rig(force_noise=NOISE, seed=seed).measure(true) for seed in range(3)]
    folder = tmp_path_factory.mktemp("materials")
    softer = MaterialFile.of(with_values(scene.material, {"C10": 1200.0}), provenance={"method": "written by hand"})
    ts.write_material_file(softer, folder / "softer.material.json")
    shown = Shown(replace(scene, measurements={NEEDLE.name: build_measurement_from_replicates(replicates)}), folder)
    SHARED.callback(shown.close)
    return shown


@pytest.fixture(scope="module")
def shown_solid(browser, tmp_path_factory):
    """Viewer of a coarse solid in 3D under an inclined tool away from the axis."""
    import math

    from coarse_solid import make_coarse_solid

    import tissue_sim as ts
    from scenes.commands.shared.experiment_flags import load_material_or_study_silicone
    from scenes.viewer.scene import Scene
    from tissue_sim.experiment.kinds.standard_tests import NEEDLE
    from tissue_sim.fem.solver import SOLVERS

    experiment = NEEDLE.experiment(
        specimen=ts.Specimen(0.04, 0.07), protocol=ts.Protocol.ramp(2e-3, 3), tool=ts.Tool("round", radius=8e-3),
        friction=0.3, approach=ts.Approach(8e-3, math.radians(10.0)))
    SOLVERS.register(make_coarse_solid, "coarse_solid")
    scene = Scene(NEEDLE, experiment, load_material_or_study_silicone(None), solver="coarse_solid")
    shown = Shown(scene, tmp_path_factory.mktemp("materials"), patience=1e4)
    try:
        yield shown
    finally:
        shown.close()
        SOLVERS.unregister("coarse_solid")


@pytest.fixture(scope="module")
def shown_block(browser, tmp_path_factory):
    """Viewer of a reduced block whose top is attached to a needle away from its middle."""
    import tissue_sim as ts
    from scenes.viewer.scene import Scene
    from tissue_sim.experiment.kinds.standard_tests import NEEDLE

    experiment = NEEDLE.experiment(
        specimen=ts.Specimen(shape="block", length=0.030, width=0.024, height=0.015),
        protocol=ts.Protocol.ramp(2e-3, 2), tool=ts.Tool("flat", radius=4e-3), approach=ts.Approach(2e-3))
    material = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e3), layers=(ts.Layer(2e-3, 3.0),))
    reduced = ts.reduce_solid(ts.Model(experiment, material), ts.PoseBox(1e-3, 2e-3), strokes=3, modes=6,
                              sampling=0.05, tried=1)
    shown = Shown(Scene(NEEDLE, reduced.model.experiment, material, solver="reduced", reduced=reduced),
                  tmp_path_factory.mktemp("materials"))
    try:
        yield shown
    finally:
        shown.close()


@pytest.fixture(scope="module")
def shown_reduced(browser, tmp_path_factory):
    """Viewer of a reduced solid attached to a flat needle."""
    import tissue_sim as ts
    from scenes.viewer.scene import Scene
    from tissue_sim.experiment.kinds.standard_tests import NEEDLE

    material = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e3))
    experiment = NEEDLE.experiment(specimen=ts.Specimen(0.03, 0.02), protocol=ts.Protocol.ramp(2e-3, 3),
                                   tool=ts.Tool("flat", radius=8e-3), friction="bonded")
    reduced = ts.reduce_solid(ts.Model(experiment, material), ts.PoseBox(1.5e-3, 2.5e-3), strokes=6, modes=12, tried=1)
    shown = Shown(Scene(NEEDLE, experiment, material, solver="reduced", reduced=reduced),
                  tmp_path_factory.mktemp("materials"), patience=1e4)
    try:
        yield shown
    finally:
        shown.close()


class Reader:
    """Driver of a browser page of the viewer, with the actions and observations of a user.

    Attributes:
        page: Page of Playwright.
        shown: Displayed viewer.
        traffic: Requests and errors of the page.
        client: Client handle of viser for this browser.
    """

    def __init__(self, page, shown: Shown, chromium, traffic: Traffic):
        self.page, self.shown, self.traffic, self._chromium = page, shown, traffic, chromium
        self._meet()

    def _meet(self) -> None:
        clients = self.shown.page.server.get_clients()
        self.client = clients[max(clients)]

    def read(self, name: str) -> str:
        return self.page.get_by_test_id(name).inner_text()

    def number(self, name: str) -> float:
        return float(self.read(name).split()[0])

    def wait_for(self, name: str, text: str) -> None:
        """Wait until a read-out has this text."""
        self.until(lambda: self.read(name), lambda seen: seen == text)

    def until(self, look, fits, seconds: float = PATIENCE):
        """Call `look` until its result satisfies `fits`, and return the result; the browser runs in the meantime."""
        deadline = time.monotonic() + seconds
        while not fits(seen := look()):
            assert time.monotonic() < deadline, f"the condition is not satisfied by {seen}"
            self.page.wait_for_timeout(20)
        return seen

    def reload(self) -> None:
        """Reload the page."""
        self.page.reload()
        self._chromium.come_up(self.page)
        self._meet()

    def phase(self, name: str) -> None:
        """Wait until the simulation is in this phase."""
        self.page.locator(f"[data-testid=phase][data-phase={name}]").wait_for(timeout=PATIENCE * 1e3)

    def tab(self, name: str) -> None:
        self.page.get_by_role("tab", name=name, exact=True).click()

    def press(self, name: str) -> None:
        self._rest()
        self.page.get_by_role("button", name=name, exact=True).click()

    def field(self, label: str):
        """Return the input field with a label; for a slider, its number field."""
        return self._chromium.text_field(self.page, label)

    def slider(self, label: str):
        """Return the thumb of a slider."""
        return self.page.locator(f'xpath=//label[normalize-space(.)="{label}"]/following::*[@role="slider"][1]')

    def _rest(self) -> None:
        """Until viser's page has sent what was done before.

        It sends one message in 50 ms, the newest of whatever control: two that are changed faster than a person can,
        while one more is under way, lose the first. By the page's own clock, as a busy browser's timers come late: the
        first of these comes after the one that sends, the second after the one that this sets.
        """
        for _ in range(2):
            self.page.evaluate("() => new Promise(done => setTimeout(done, 60))")

    def fill(self, label: str, text: str) -> None:
        self._rest()
        self.field(label).fill(text)
        self.field(label).press("Enter")

    def enter(self, label: str, number: str) -> None:
        """Type a number key by key, because the page ignores a filled-in number that equals an earlier one."""
        self._rest()
        field = self.field(label)
        field.press("Control+a")
        field.press_sequentially(number)
        field.press("Enter")

    def tick(self, label: str) -> None:
        """Toggle a checkbox."""
        self._rest()
        self.field(label).click()

    def choose(self, label: str, option: str) -> None:
        """Choose an option of a list."""
        self._rest()
        self.field(label).click()
        self.page.get_by_role("option", name=option, exact=True).click()

    def answer(self, text: str) -> None:
        """Wait for a notification that contains this text, and close it."""
        notice = self.page.get_by_role("alert").filter(has_text=text)
        self.until(self.page.get_by_role("alert").all_inner_texts, lambda said: any(text in each for each in said))
        notice.get_by_role("button").click()
        notice.wait_for(state="detached")

    def download(self, button: str):
        """Press a button and return the downloaded file."""
        with self.page.expect_download() as coming:
            self.press(button)
        return coming.value

    def downloads(self, button: str, count: int) -> list:
        """Press a button and return the downloaded files in order."""
        files: list = []

        def take(download) -> None:
            files.append(download)

        self.page.on("download", take)
        try:
            self.press(button)
            return self.until(lambda: files, lambda come: len(come) == count)
        finally:
            self.page.remove_listener("download", take)

    def curves(self) -> list[dict]:
        """Return for each plot, from the top, the finite values of each series by its label."""
        return self.page.evaluate("""() => Object.values(window.__viserTestpoints.uplots)
            .map(({chart}) => ({top: chart.root.getBoundingClientRect().top, series: Object.fromEntries(
                chart.series.map((one, k) => [one.label, Array.from(chart.data[k]).filter(Number.isFinite)]))}))
            .sort((a, b) => a.top - b.top).map(plot => plot.series)""")

    def place(self, point) -> tuple[float, float]:
        """Return the position on the page, pixels, of a point of the scene, browser units."""
        import numpy as np

        camera = self.client.camera
        forward = camera.look_at - camera.position
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, camera.up_direction)
        right /= np.linalg.norm(right)
        away = np.asarray(point) - camera.position
        half = np.tan(0.5 * camera.fov) * (away @ forward)
        across, up = away @ right / (half * camera.aspect), away @ np.cross(right, forward) / half
        box = self.page.locator("canvas").first.bounding_box()
        return box["x"] + 0.5 * box["width"] * (1.0 + across), box["y"] + 0.5 * box["height"] * (1.0 - up)


@pytest.fixture(scope="session")
def desk(shown, browser, chromium):
    """Reader of a browser page that stays open for all tests."""
    open_one = SHARED.enter_context(pages_of(browser, chromium))
    page = open_one(shown, width=1200, height=760, triangles=100)
    return Reader(page, shown, chromium, open_one.traffic(page))


@pytest.fixture
def reader_of(open_page, chromium):
    """``reader_of(page, shown)``: a reader of a page that `open_page` gave."""
    return lambda page, shown: Reader(page, shown, chromium, open_page.traffic(page))


@pytest.fixture
def reader(desk):
    """`desk` after a reset of the scene: tool at the surface of undeformed tissue."""
    desk.shown.begin_again()
    desk.tab("Motion")
    desk.wait_for("depth", "0.00")
    yield desk
    assert (desk.traffic.foreign(desk.shown), desk.traffic.failed, desk.traffic.errors) == ([], [], [])


@pytest.fixture
def another(reader, open_page, chromium):
    """Reader of a second browser page of the same viewer."""
    page = open_page(reader.shown, width=1200, height=760, triangles=100)
    return Reader(page, reader.shown, chromium, open_page.traffic(page))


@pytest.fixture
def stranger(browser):
    """Open a page of another server, ``with stranger() as page``, without checks for errors."""

    @contextmanager
    def open_one():
        with browser.new_context() as context:
            page = context.new_page()
            page.set_default_timeout(PATIENCE * 1e3)
            yield page

    return open_one
