// Draws the parts of a page as they arrive, and sends what a viewer does. Texts are only ever set as text.
"use strict";

const at = id => document.getElementById(id);
function made(tag, kind = "", text = "") {
  const element = document.createElement(tag);
  if (kind) element.className = kind;
  if (text) element.textContent = text;
  return element;
}
function headed(part) {
  const box = made("div", part.kind);
  if (part.head) box.append(made("h2", part.tone, part.head));
  return box;
}

const draw = {
  lines(part) {
    const box = headed(part);
    for (const line of part.lines) box.append(made("p", part.tone, line));
    return box;
  },
  numbers(part) {
    const box = headed(part);
    for (const row of part.rows) {
      const one = made("div", `number ${row.size}`);
      one.append(made("div", "label", row.label), made("span", `value ${row.tone}`, `${row.value}\u00a0${row.unit}`));
      if (row.sigma) one.append(" ", made("span", "sigma", row.sigma));
      if (row.note) one.append(made("div", "quiet", row.note));
      box.append(one);
    }
    return box;
  },
  table(part) {
    const box = headed(part), rows = made("table");
    for (const [tag, cells] of [["th", part.columns], ...part.rows.map(row => ["td", row])]) {
      const line = made("tr");
      for (const cell of cells) line.append(made(tag, "", cell));
      if (cells.length) rows.append(line);
    }
    box.append(rows);
    return box;
  },
  bars(part) {
    const box = headed(part);
    for (const row of part.rows) {
      const line = made("div", `bar ${row.tone} ${row.label ? "" : "whole"}`), rail = made("i", row.signed ? "signed" : "");
      const fill = made("b"), share = 100 * Math.abs(row.share);
      fill.style.width = `${row.signed ? share / 2 : share}%`;
      fill.style.left = row.signed ? `${row.share < 0 ? 50 - share / 2 : 50}%` : 0;
      rail.append(fill);
      if (row.label) line.append(made("span", "", row.label));
      line.append(rail, made("span", "", row.text));
      box.append(line);
    }
    return box;
  },
};

// Controls keep their elements, so that a field does not lose what is being typed.
const fields = {
  button(control) {
    const button = made("button", control.tone, control.label);
    button.type = "button";
    if (control.key) button.append(made("kbd", "", `key ${control.key}`));
    // Stop is sent when a finger touches it; a click without one comes from the keyboard.
    button.onclick = event => { if (control.name !== "stop" || !event.detail) ask(control.name, null); };
    return [button, button, () => null];
  },
  text: control => field(control, "input", "text", input => input.value),
  check: control => field(control, "input", "checkbox", input => input.checked),
  range: control => field(control, "input", "range", input => Number(input.value)),
  select: control => field(control, "select", "", input => input.value),
};
function field(control, tag, type, value) {
  const box = made("label", "field"), input = made(tag);
  if (type) input.type = type;
  box.append(made("span", "", control.label), input, made("small"));
  const send = () => { clearTimeout(input.waits); input.waits = 0; ask(control.name, value(input)); };
  // What is typed is sent after a pause, so that not each letter is judged, and when the field is left for a button.
  input.oninput = () => {
    input.dataset.typed = Date.now();
    if (type === "text") clearTimeout(input.waits);
    else if (input.waits) return;
    input.waits = setTimeout(send, type === "text" ? 250 : 40);
  };
  input.onchange = () => { if (input.waits) send(); };
  return [box, input, value];
}
function controls(box, part) {
  const known = box.known ??= new Map(), names = new Set(part.controls.map(control => control.name));
  if (!box.row) box.append(box.head = made("h2"), box.note = made("p", "quiet"), box.row = made("div", "controls"));
  box.head.textContent = part.head;
  box.note.textContent = part.note;
  box.head.hidden = !part.head;
  box.note.hidden = !part.note;
  for (const [name, [element]] of known) if (!names.has(name)) { element.remove(); known.delete(name); }
  for (const control of part.controls) {
    if (!known.has(control.name)) known.set(control.name, fields[control.type](control));
    const [element, input, value] = known.get(control.name);
    if (box.row.children[part.controls.indexOf(control)] !== element) box.row.insertBefore(element, box.row.children[part.controls.indexOf(control)] ?? null);
    input.disabled = Boolean(control.disabled);
    if (control.type === "button") {
      if (input.firstChild.textContent !== control.label) input.firstChild.textContent = control.label;
      continue;
    }
    element.children[0].textContent = control.label;
    const small = element.lastChild;
    small.textContent = control.words ?? control.text ?? "";
    small.className = control.tone ?? "quiet";
    if (control.type === "select" && [...input.options].map(one => one.value).join("\n") !== control.options.join("\n")) {
      input.replaceChildren(...control.options.map(option => new Option(option, option)));
    }
    if (control.type === "range") Object.assign(input, { min: 0, max: control.max, step: control.step });
    // The value of the server counts, but not while somebody types or drags.
    const busy = Date.now() - (input.dataset.typed ?? 0) < 1000;
    if (!busy && value(input) !== control.value) input[control.type === "check" ? "checked" : "value"] = control.value;
  }
}

function plots(place, part) {
  const colour = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  place.drawn ??= [];
  place.newest = part;
  part.plots.forEach((plot, i) => {
    const n = plot.low.length, t = Array.from({ length: n }, (_, k) => (k + 1 - n) * part.step_s);
    const sigma = t.map(() => plot.sigma), minus = t.map(() => -plot.sigma);
    const edge = t.map(() => -part.full[plot.unit]), contact = part.contact.map(one => one ? part.full[plot.unit] : -part.full[plot.unit]);
    const data = [t, plot.low, plot.high, sigma, minus, contact, edge];
    let shown = place.drawn[i];
    if (!shown) {
      const box = made("div"), head = made("h3");
      box.append(head);
      place.append(box);
      const line = stroke => ({ width: 1, stroke, points: { show: false } });
      const axis = { stroke: () => colour("--quiet"), grid: { stroke: () => colour("--line"), width: 1 }, ticks: { show: false }, font: "13px system-ui" };
      shown = place.drawn[i] = new uPlot({
        width: box.clientWidth || 240, height: 120, legend: { show: false }, padding: [6, 8, 0, 0],
        cursor: { sync: { key: "plots" }, drag: { x: false, y: false } },
        scales: { x: { time: false, range: () => [-place.newest.span_s, 0] }, y: { range: () => [-place.newest.full[plot.unit], place.newest.full[plot.unit]] } },
        axes: [{ ...axis, size: 22, space: 40 }, { ...axis, size: 44, space: 18 }],
        series: [{}, line(() => colour("--ask")), line(() => colour("--ask")), line(() => colour("--quiet")), line(() => colour("--quiet")), line("transparent"), line("transparent")],
        bands: [{ series: [5, 6], fill: "rgba(235,130,40,.28)" }, { series: [3, 4], fill: "rgba(134,142,150,.3)" }, { series: [2, 1], fill: "rgba(60,130,230,.5)" }],
      }, null, box);
      new ResizeObserver(() => shown.setSize({ width: box.clientWidth, height: 120 })).observe(box);
      shown.head = head;
    }
    shown.head.textContent = `${plot.label} ${plot.unit}`;
    shown.setData(data);
  });
}

function show(name, part) {
  const slash = name.indexOf("/"), slot = slash < 0 ? name : name.slice(0, slash);
  if (slot === "scene") { at("scene").hidden = false; scene.put(name, part); return; }
  if (name === "title") { at("title").textContent = document.title = part.text; return; }
  if (name === "viewer") { at("viewer").textContent = `you are viewer ${part.number}`; return; }
  const place = at(slot);
  if (slot === "plots") { place.hidden = !part; if (part) plots(place, part); return; }
  let box = [...place.children].find(child => child.dataset.part === name);
  if (part?.kind === "controls") {
    if (!box) { place.append(box = made("div")); box.dataset.part = name; }
    controls(box, part);
  } else if (part) {
    const drawn = draw[part.kind](part);
    drawn.dataset.part = name;
    if (box) box.replaceWith(drawn); else place.append(drawn);
  } else box?.remove();
  place.hidden = !place.children.length;
}

// What a viewer does, in its order; only Stop waits for nothing.
let turn = Promise.resolve();
function ask(name, value) {
  if (name === "stop") post(name, value); else turn = turn.then(() => post(name, value));
}
async function post(name, value) {
  const stops = name === "stop", words = stops ? at("stop") : at("controls");
  words.querySelector(".answer")?.remove();
  const waits = new AbortController(), late = setTimeout(() => waits.abort(), stops ? 1500 : 5000);
  try {
    const answer = await fetch("/do", { method: "POST", headers: { "Content-Type": "application/json" },
      body: JSON.stringify({ name, value }), signal: waits.signal, priority: "high", keepalive: true });
    if (!answer.ok) throw new Error((await answer.text()).trim());
    const button = at("stop").querySelector("button");
    if (stops && button) button.firstChild.textContent = "Stop was sent";
  } catch (error) {
    const sentence = stops ? "Stop was NOT sent; trying again. Press q in the terminal, or the emergency stop." : `Not accepted: ${error.message}`;
    if (stops && error.name !== "Error" && !ended) setTimeout(() => post(name, value), 300);  // it did not arrive
    words.hidden = false;
    words.append(made("p", "answer bad", sentence));
  } finally { clearTimeout(late); }
}
document.addEventListener("pointerdown", event => { if (event.target.closest("#stop button")) ask("stop", null); });
document.addEventListener("keydown", event => {
  if (event.key === "q" && !event.ctrlKey && !event.metaKey && !at("stop").hidden && !event.target.matches("input, select")) ask("stop", null);
});

// The stream of parts. A hidden page gives its connection up, because a browser has six for all pages of a program.
let stream = null, heard = Date.now(), ended = false;
function lost(words) {
  at("lost").hidden = !words;
  at("lost").textContent = words;
  document.body.classList.toggle("old", Boolean(words) && !ended);
}
function open() {
  if (stream || ended || document.hidden) return;
  stream = new EventSource("/parts");
  heard = Date.now();
  stream.onmessage = event => {
    heard = Date.now();
    for (const [name, part] of Object.entries(JSON.parse(event.data))) show(name, part);
  };
  stream.addEventListener("beat", event => {
    heard = Date.now();
    const stale_s = Number(event.data);
    lost(stale_s > 2 ? `This page has not been drawn for ${stale_s.toFixed(0)} s: its values are old. The program runs.` : "");
  });
  stream.addEventListener("end", () => {
    ended = true;
    stream.close();
    at("stop").hidden = true;
    lost("");
    at("viewer").textContent = `ended ${new Date().toLocaleTimeString()}, last state`;
    for (const input of document.querySelectorAll("#side button, #side input, #side select")) input.disabled = true;
  });
}
document.addEventListener("visibilitychange", () => {
  if (document.hidden) { stream?.close(); stream = null; } else open();
});
setInterval(() => {
  if (ended || document.hidden || Date.now() - heard < 3000) return;
  lost(`Nothing received from the program for ${((Date.now() - heard) / 1000).toFixed(0)} s: these values are old.`);
  if (stream?.readyState === EventSource.CLOSED) { stream = null; const before = heard; open(); heard = before; }
}, 500);
open();
