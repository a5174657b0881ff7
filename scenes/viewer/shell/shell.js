"use strict";
(() => {
  const { largestUpload } = window.__shell;

  // Remove the loading screen when the scene has arrived; after 15 s without data, ask about the server.
  const loading = document.getElementById("shell-loading");
  const loadingText = document.getElementById("shell-words");
  const began = performance.now();
  const waiting = setInterval(() => {
    const mutable = window.__viserMutable;
    if (mutable && !mutable.firstMessageBatch) {
      clearInterval(waiting);
      loading.classList.add("shell-gone");
      setTimeout(() => loading.remove(), 300);
    } else if (performance.now() - began > 15e3) {
      loadingText.textContent = "The server has not sent any data yet. Check that the command that printed the address "
        + "is still running.";
    }
  }, 50);

  // Notes: a sentence next to a field, shown for 8 s.
  let note = null, noteTimer = 0;
  const hideNote = () => { clearTimeout(noteTimer); note?.remove(); note = null; };
  const showNote = (field, sentence) => {
    hideNote();
    note = document.createElement("div");
    note.className = "shell-note";
    note.setAttribute("role", "status");
    note.dataset.testid = "field-note";
    note.textContent = sentence;
    document.body.append(note);
    const fieldBox = field.getBoundingClientRect(), noteBox = note.getBoundingClientRect();
    note.style.left = `${Math.max(4, Math.min(fieldBox.left, innerWidth - noteBox.width - 8))}px`;
    note.style.top = `${Math.min(fieldBox.bottom + 4, innerHeight - noteBox.height - 4)}px`;
    noteTimer = setTimeout(hideNote, 8e3);
  };

  // viser's number fields drop unknown characters (1e300 becomes 1300) and silently replace a number outside of the
  // range by the nearest limit. Reject such input instead, and name the limit that is used.
  const isNumberField = (field) => field instanceof HTMLInputElement
    && field.closest(".mantine-NumberInput-root") !== null;
  const decimal = /^[-+]?[0-9]*[.,]?[0-9]*$/;
  let rejecting = null, typed = null, before = "";  // rejecting: field that ignores keys until it is left or cleared
  const setValue = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set;
  const restore = (field) => {
    if (field.value === before) return;
    setValue.call(field, before);
    field.dispatchEvent(new Event("input", { bubbles: true }));
    typed = null;
  };
  document.addEventListener("focusin", (event) => {
    if (isNumberField(event.target)) before = event.target.value;
  }, true);
  document.addEventListener("beforeinput", (event) => {
    const field = event.target;
    if (!isNumberField(field)) return;
    if (!event.inputType.startsWith("insert")) { rejecting = null; return; }
    const text = event.data ?? "";
    const whole = field.value.slice(0, field.selectionStart) + text + field.value.slice(field.selectionEnd);
    if (field.selectionStart === 0 && field.selectionEnd === field.value.length) rejecting = null;
    if (rejecting === field || !decimal.test(whole)) {
      event.preventDefault();
      event.stopImmediatePropagation();
      if (rejecting === field) return;
      rejecting = field;
      restore(field);
      showNote(field, `“${whole}” is not a decimal number. Use digits, a point and a minus sign, for example 0.0013 `
        + `instead of 1.3e-3. The field keeps ${before}. To type again, select its whole text or leave the field.`);
    }
  }, true);
  document.addEventListener("input", (event) => {
    if (isNumberField(event.target)) { typed = { field: event.target, text: event.target.value }; hideNote(); }
  }, true);
  const checkEntry = (field) => {
    rejecting = null;
    if (typed?.field !== field) return;
    const { text } = typed;
    typed = null;
    setTimeout(() => {
      const entered = parseFloat(text.replace(",", ".")), used = parseFloat(field.value.replace(",", "."));
      if (text.trim() === "" || text === "-") {
        restore(field);
        showNote(field, `No number was entered. The field keeps ${before}.`);
      } else if (Number.isFinite(entered) && Number.isFinite(used)
                 && Math.abs(entered - used) > 1e-6 * Math.abs(entered)) {
        showNote(field, `${text} is outside the range of this field. The nearest limit ${field.value} is used.`);
      }
    }, 400);
  };
  document.addEventListener("focusout", (event) => isNumberField(event.target) && checkEntry(event.target), true);
  document.addEventListener("keydown", (event) => {
    if (event.key === "Enter" && isNumberField(event.target)) event.target.blur();
  }, true);

  // Reject too large files in the browser, before they are uploaded.
  document.addEventListener("change", (event) => {
    const field = event.target;
    if (!(field instanceof HTMLInputElement) || field.type !== "file") return;
    const large = Array.from(field.files ?? []).find((file) => file.size > largestUpload);
    if (large === undefined) return;
    event.stopImmediatePropagation();
    field.value = "";
    showNote(field.parentElement, `Files must be at most ${largestUpload / 1e6} MB; ${large.name} has `
      + `${Math.ceil(large.size / 1e6)} MB.`);
  }, true);
  // viser reports success after the upload, before the file is read.
  new MutationObserver((changes) => {
    for (const { target } of changes) {
      const notice = (target instanceof Element ? target : target.parentElement)?.closest("[role=alert]");
      for (const line of notice?.querySelectorAll(".mantine-Notification-description") ?? []) {
        if (line.textContent === "File uploaded successfully.") line.textContent = "The file was uploaded and is being read.";
      }
    }
  }).observe(document.body, { childList: true, subtree: true });

  // Stretch the plots, which are made for a window of 720 pixels, to the height of their panel.
  const heights = new Map();
  const stretchPlots = () => {
    const charts = Object.values(window.__viserTestpoints?.uplots ?? {}).map(({ chart }) => chart)
      .filter((chart) => chart.root.isConnected && chart.root.offsetParent !== null);
    if (charts.length < 2) return;
    let panel = charts[0].root.parentElement;
    while (panel && !/(auto|scroll)/.test(getComputedStyle(panel).overflowY)) panel = panel.parentElement;
    if (!panel) return;
    const plots = charts.map((chart) => {
      if (!heights.has(chart)) heights.set(chart, chart.height);
      return { chart, usual: heights.get(chart) };
    });
    const used = plots.reduce((sum, { chart }) => sum + chart.height, 0);
    const usual = plots.reduce((sum, plot) => sum + plot.usual, 0);
    const content = Array.from(panel.children).reduce((sum, child) => sum + child.getBoundingClientRect().height, 0);
    const available = panel.clientHeight - (content - used) - 12;
    const factor = Math.max(1, Math.min(available / usual, 2));
    for (const { chart, usual: height } of plots) {
      const stretched = Math.round(height * factor);
      if (Math.abs(stretched - chart.height) > 2) chart.setSize({ width: chart.width, height: stretched });
    }
    for (const chart of heights.keys()) if (!charts.includes(chart)) heights.delete(chart);
  };
  setInterval(stretchPlots, 500);
  addEventListener("resize", stretchPlots);
})();
