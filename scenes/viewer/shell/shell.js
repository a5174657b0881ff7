"use strict";
(() => {
  const { largestUpload } = window.__shell;

  // The loading screen goes when the scene has arrived, and says so when nothing comes.
  const loading = document.getElementById("shell-loading");
  const words = document.getElementById("shell-words");
  const began = performance.now();
  const waiting = setInterval(() => {
    const mutable = window.__viserMutable;
    if (mutable && !mutable.firstMessageBatch) {
      clearInterval(waiting);
      loading.classList.add("shell-gone");
      setTimeout(() => loading.remove(), 300);
    } else if (performance.now() - began > 15e3) {
      words.textContent = "Nothing has come yet. Is the command that printed the address still running?";
    }
  }, 50);

  // A sentence beside a field.
  let note = null, fading = 0;
  const hush = () => { clearTimeout(fading); note?.remove(); note = null; };
  const say = (field, sentence) => {
    hush();
    note = document.createElement("div");
    note.className = "shell-note";
    note.setAttribute("role", "status");
    note.dataset.testid = "field-note";
    note.textContent = sentence;
    document.body.append(note);
    const place = field.getBoundingClientRect(), own = note.getBoundingClientRect();
    note.style.left = `${Math.max(4, Math.min(place.left, innerWidth - own.width - 8))}px`;
    note.style.top = `${Math.min(place.bottom + 4, innerHeight - own.height - 4)}px`;
    fading = setTimeout(hush, 8e3);
  };

  // viser's number fields drop what they do not know, take what is left over (1e300 becomes 1300), and go to the
  // nearest end of their range. Here what is no number is not taken at all, and an end that is gone to is named.
  const numeric = (field) => field instanceof HTMLInputElement && field.closest(".mantine-NumberInput-root") !== null;
  const plain = /^[-+]?[0-9]*[.,]?[0-9]*$/;
  let spoilt = null, typed = null, before = "";
  const write = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set;
  const restore = (field) => {
    if (field.value === before) return;
    write.call(field, before);
    field.dispatchEvent(new Event("input", { bubbles: true }));
    typed = null;
  };
  document.addEventListener("focusin", (event) => { if (numeric(event.target)) before = event.target.value; }, true);
  document.addEventListener("beforeinput", (event) => {
    const field = event.target;
    if (!numeric(field)) return;
    if (!event.inputType.startsWith("insert")) { spoilt = null; return; }
    const text = event.data ?? "";
    const whole = field.value.slice(0, field.selectionStart) + text + field.value.slice(field.selectionEnd);
    if (field.selectionStart === 0 && field.selectionEnd === field.value.length) spoilt = null;
    if (spoilt === field || !plain.test(whole)) {
      event.preventDefault();
      event.stopImmediatePropagation();
      if (spoilt === field) return;
      spoilt = field;
      restore(field);
      say(field, `“${whole}” is not taken: digits, a point and a minus sign only, such as 0.0013 for 1.3e-3. `
        + `The field stays at ${before}; leave it, or select all, to type again.`);
    }
  }, true);
  document.addEventListener("input", (event) => {
    if (numeric(event.target)) { typed = { field: event.target, text: event.target.value }; hush(); }
  }, true);
  const compare = (field) => {
    spoilt = null;
    if (typed?.field !== field) return;
    const { text } = typed;
    typed = null;
    setTimeout(() => {
      const was = parseFloat(text.replace(",", ".")), is = parseFloat(field.value.replace(",", "."));
      if (text.trim() === "" || text === "-") {
        restore(field);
        say(field, `Nothing was entered: ${before} stays.`);
      } else if (Number.isFinite(was) && Number.isFinite(is) && Math.abs(was - is) > 1e-6 * Math.abs(was)) {
        say(field, `${text} is outside of what this field takes: ${field.value} is used, the nearest.`);
      }
    }, 400);
  };
  document.addEventListener("focusout", (event) => numeric(event.target) && compare(event.target), true);
  document.addEventListener("keydown", (event) => {
    if (event.key === "Enter" && numeric(event.target)) event.target.blur();
  }, true);

  // A file that is too large does not leave the browser.
  document.addEventListener("change", (event) => {
    const field = event.target;
    if (!(field instanceof HTMLInputElement) || field.type !== "file") return;
    const large = Array.from(field.files ?? []).find((file) => file.size > largestUpload);
    if (large === undefined) return;
    event.stopImmediatePropagation();
    field.value = "";
    say(field.parentElement, `${large.name} has ${Math.ceil(large.size / 1e6)} MB; this page takes files of up to `
      + `${largestUpload / 1e6} MB.`);
  }, true);
  // That it has arrived says nothing of whether it is understood.
  new MutationObserver((changes) => {
    for (const { target } of changes) {
      const notice = (target instanceof Element ? target : target.parentElement)?.closest("[role=alert]");
      for (const line of notice?.querySelectorAll(".mantine-Notification-description") ?? []) {
        if (line.textContent === "File uploaded successfully.") line.textContent = "It has arrived, and is being read.";
      }
    }
  }).observe(document.body, { childList: true, subtree: true });

  // Plots take the height that their panel has; they are laid out for a window of 720 pixels.
  const heights = new Map();
  const spread = () => {
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
    const room = panel.clientHeight - (content - used) - 12;
    const share = Math.max(1, Math.min(room / usual, 2));
    for (const { chart, usual: height } of plots) {
      const wanted = Math.round(height * share);
      if (Math.abs(wanted - chart.height) > 2) chart.setSize({ width: chart.width, height: wanted });
    }
    for (const chart of heights.keys()) if (!charts.includes(chart)) heights.delete(chart);
  };
  setInterval(spread, 500);
  addEventListener("resize", spread);
})();
