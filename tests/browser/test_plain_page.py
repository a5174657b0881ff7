"""Page of viser behind the checked server: it loads without a network and communicates in both directions."""

import numpy as np
import pytest
import viser

from scenes.viewer.web_server import open_viewer_server


@pytest.fixture
def server():
    with open_viewer_server(port=0, title="plain page") as running:
        scene = running.scene
        scene.configure_environment_map(hdri=None)
        scene.configure_default_lights(enabled=False)
        scene.add_light_ambient("/light", intensity=2.0)
        scene.add_mesh_simple("/triangle", np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]),
                              color=(200, 30, 30), side="double", cast_shadow=False, receive_shadow=False)
        running.initial_camera.position, running.initial_camera.look_at = (0.5, 0.5, 3.0), (0.5, 0.5, 0.0)
        running.initial_camera.up = (0.0, 1.0, 0.0)
        yield running


@pytest.mark.slow
def test_the_page_loads_offline(server, open_page):
    depth = np.linspace(0.0, 1.0, 11)
    server.gui.add_uplot(data=(depth, depth**2), series=(viser.uplot.Series(label="depth"),
                                                         viser.uplot.Series(label="force", stroke="red")))
    server.gui.add_markdown("read **this**")
    page = open_page(server, triangles=1)
    assert page.title() == "plain page"
    page.get_by_text("this").wait_for()
    page.locator(".uplot canvas").wait_for()
    asked = open_page.traffic(page).urls
    assert asked[0] == f"{server.local_url}/?fixedDpr=0.2"
    assert f"ws://127.0.0.1:{server.get_port()}/" in asked


@pytest.mark.slow
def test_clicks_and_replies_are_transmitted(server, open_page, chromium):
    button = server.gui.add_button("push")
    answer = server.gui.add_html("<span data-testid='answer'>not yet</span>")

    @button.on_click
    def _(event):
        answer.content = f"<span data-testid='answer'>pushed by {event.client.client_id}</span>"

    page = open_page(server, triangles=1)
    page.get_by_role("button", name="push").click()
    page.get_by_test_id("answer").filter(has_text="pushed by 0").wait_for()
    page.reload()
    chromium.come_up(page)
    page.get_by_test_id("answer").filter(has_text="pushed by 0").wait_for()


@pytest.mark.slow
def test_picture_is_saved(server, open_page, chromium, tmp_path):
    from matplotlib.image import imread

    page = open_page(server, width=640, height=480, triangles=1, pixel_ratio=1.0)
    chromium.save_picture(page, tmp_path / "page.png")
    picture = imread(tmp_path / "page.png")[..., :3]
    assert picture.shape == (480, 640, 3)
    red = (picture[..., 0] > 0.3) & (picture[..., 1:].max(axis=-1) < 0.2)
    assert 0.002 < red.mean() < 0.2  # the triangle, and not the whole page


@pytest.fixture
def guarded():
    with open_viewer_server(port=0, title="guarded", token="secret") as running:
        running.gui.add_markdown("behind a token")
        yield running


@pytest.mark.slow
def test_the_address_with_token_opens_the_page_and_the_cookie_reopens_it(guarded, open_page, chromium):
    """The cookie from the first visit also opens the websocket and a reload."""
    page = open_page(guarded)
    page.get_by_text("behind a token").wait_for()
    page.goto(guarded.local_url)
    chromium.come_up(page, triangles=0)
    page.get_by_text("behind a token").wait_for()


def test_a_request_without_the_token_gets_an_explanation(guarded, browser):
    page = browser.new_page()
    reply = page.goto(guarded.local_url)
    assert reply.status == 403 and "the complete address that was printed" in reply.text()
    page.close()
