"""Additions to viser's page: notes about rejected numbers and uploads, keys, and the height of the plots."""

import pytest

from scenes.viewer.shell import LARGEST_UPLOAD


def note(reader, text):
    """Wait for a note next to a field with this text; a single wait, because the note disappears after 8 s."""
    reader.page.get_by_test_id("field-note").filter(has_text=text).first.wait_for()


@pytest.mark.slow
def test_a_field_accepts_decimal_numbers_only_and_explains_each_rejection(shown, reader):
    reader.enter("depth [mm]", "2")
    reader.wait_for("depth", "2.00")
    field = reader.field("depth [mm]")
    for typed in ("1e300", "nan", "0x4"):
        # Keys of the field; keys of the page would wait for ever.
        field.press("Control+a")
        field.press_sequentially(typed)
        note(reader, "is not a decimal number")
        reader.until(field.input_value, lambda value: value == "2")
        field.press("Tab")
        reader.until(lambda: shown.frame.target, lambda depth: depth == pytest.approx(2e-3))
    reader.enter("depth [mm]", "99999")
    note(reader, "99999 is outside the range of this field. The nearest limit 5 is used.")
    reader.wait_for("depth", "5.00")
    field.press("Control+a")
    field.press("Delete")
    field.press("Tab")
    note(reader, "No number was entered. The field keeps 5.")
    assert field.input_value() == "5" and shown.frame.target == pytest.approx(5e-3)


def type_slowly(reader, label, text, is_applied):
    """Type key by key; before each key, wait for two frames with the effect of the previous key."""
    field, shown = reader.field(label), reader.shown
    field.press("Control+a")
    for count, key in enumerate(text, 1):
        field.press(key)
        reader.until(lambda: shown.frame, lambda frame, typed=text[:count]: is_applied(frame, typed))
        for _ in range(2):
            before = shown.frame
            reader.until(lambda: shown.frame, lambda frame, before=before: frame is not before)
    reader.page.evaluate("() => new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(drawn)))")
    assert field.input_value() == text
    field.press("Enter")


@pytest.mark.slow
def test_slow_typing_of_a_number_outside_the_range_is_not_interrupted(shown, reader):
    type_slowly(reader, "depth [mm]", "34",
                lambda frame, typed: frame.target == pytest.approx(min(int(typed), 5) * 1e-3))
    note(reader, "34 is outside the range of this field. The nearest limit 5 is used.")
    reader.wait_for("depth", "5.00")
    reader.tab("Material")
    type_slowly(reader, "C10 [kPa]", "0.9",
                lambda frame, typed: typed != "0.9" or frame.scene.material.parameters["C10"] == pytest.approx(900.0))
    assert reader.page.get_by_role("alert").count() == 0


@pytest.mark.slow
def test_a_file_that_is_too_large_does_not_leave_the_browser(shown, reader, tmp_path):
    large = tmp_path / "large.material.json"
    with large.open("wb") as file:
        file.truncate(LARGEST_UPLOAD + 1)
    material = shown.session.scene.material
    reader.tab("Material")
    with reader.page.expect_file_chooser() as chooser:
        reader.press("Upload material")
    chooser.value.set_files(large)
    note(reader, "Files must be at most 20 MB; large.material.json has 21 MB.")
    assert shown.session.scene.material is material
    assert not shown.page.server.gui._current_file_upload_states


@pytest.mark.slow
def test_keys_move_and_reset_the_tool_except_while_typing(shown, reader):
    page = reader.page

    def leave_fields():
        page.evaluate("() => document.activeElement.blur()")

    leave_fields()
    for _ in range(3):
        page.keyboard.press("PageDown")
    page.keyboard.press("Shift+PageDown")
    reader.wait_for("depth", "1.30")
    page.keyboard.press("PageUp")
    reader.wait_for("depth", "1.20")
    field = reader.field("protocol")
    field.click()
    page.keyboard.type("r")
    page.keyboard.press("Control+a")
    assert shown.frame.target == pytest.approx(1.2e-3)
    leave_fields()
    page.keyboard.press("r")
    reader.wait_for("depth", "0.00")


@pytest.mark.slow
def test_moving_a_paused_tool_is_refused_with_a_message(shown, reader):
    reader.press("Pause")
    reader.phase("paused")
    reader.enter("depth [mm]", "3")
    reader.answer("The tool cannot move while the motion is paused")
    assert shown.frame.target == 0.0
    reader.press("Play")
    reader.phase("running")


@pytest.mark.slow
def test_plots_fill_the_panel_of_a_tall_window_and_fit_into_a_small_one(shown, open_page):
    for height, least in ((720, 0.0), (1080, 0.75)):
        page = open_page(shown, width=1280, height=height)
        button = page.get_by_role("button", name="Keep this model curve")
        button.wait_for()
        page.wait_for_function("""([low, high]) => {
            const buttons = Array.from(document.querySelectorAll("button"));
            const place = buttons.find((one) => one.textContent.includes("Keep this model"))?.getBoundingClientRect();
            return place && place.bottom <= high && place.bottom >= low;
        }""", arg=[least * height, height])
