"""Additions to viser's page, and the size limit of uploads."""

import re

import viser

from scenes.viewer.shell import LARGEST_UPLOAD, insert_page_additions
from scenes.viewer.web_server import open_viewer_server

PAGE = b"<html><head><title>Viser</title></head>\n  <body>\n<div id=\"root\"></div></body></html>"


def test_the_shell_is_injected_into_viser_pages_only():
    page = insert_page_additions(PAGE, "needle </script> & <tissue>").decode()
    assert "<title>needle &lt;/script&gt; &amp; &lt;tissue&gt;</title>" in page
    assert page.count("<script>") == page.count("</script>") == 2 and '<div id="root">' in page
    assert re.search(r'id="shell-loading".*id="root"', page, re.DOTALL)
    assert str(LARGEST_UPLOAD) in page
    for other in (b"a picture", b"<title>Viser</title>", b"<body>"):
        assert insert_page_additions(other, "needle") == other


def test_files_above_the_bound_are_not_kept():
    with open_viewer_server(port=0) as server:
        server.gui.add_upload_button("file")
        button, = server.gui._gui_input_handle_from_uuid
        states = server.gui._current_file_upload_states

        def say(message):
            for handler in server._websock_server._incoming_handlers[type(message)]:
                handler(7, message)

        def start(name, size, parts):
            say(viser._messages.FileTransferStartUpload(button, name, "large.json", "application/json", parts, size))

        start("large", LARGEST_UPLOAD + 1, 40)
        start("many", 1000, 10_000)
        assert not states
        start("fits", LARGEST_UPLOAD, 39)
        assert list(states) == ["fits"]
        say(viser._messages.FileTransferPart(button, "fits", 0, bytes(600 * 1024)))
        assert states["fits"]["transferred_bytes"] == 0
        say(viser._messages.FileTransferPart(button, "fits", 0, bytes(512 * 1024)))
        assert states["fits"]["transferred_bytes"] == 512 * 1024
