"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const scans = data.scans;
  const svg = document.getElementById("map");
  if (!scans.length || !svg) return;
  const overlay = document.getElementById("overlay");
  const slider = document.getElementById("slider");
  const panel = document.getElementById("scan");
  const charts = [...document.querySelectorAll(".timeline")];
  const closeup = document.getElementById("closeup");
  const layers = { candidates: true, aligned: true, hypotheses: true };
  const open = { hypotheses: true, aligned: true, candidates: !data.tracked };
  const NS = "http://www.w3.org/2000/svg";
  const full = svg.viewBox.baseVal;
  const all = { x: full.x, y: full.y, width: full.width, height: full.height };
  let view = { ...all };
  let index = 0;
  let timer = 0;
  slider.max = scans.length - 1;

  const make = (name, attributes, text) => {
    const element = document.createElementNS(NS, name);
    for (const key in attributes) element.setAttribute(key, attributes[key]);
    if (text !== undefined) element.textContent = text;
    return element;
  };
  const pixel = () => {  // metres that a pixel of the screen covers
    const matrix = svg.getScreenCTM();
    return matrix && matrix.a > 0 ? 1 / matrix.a : view.width / 700;
  };
  const metres = value => value === null ? "–" : value >= 1000 ? (value / 1000).toFixed(1) + " km"
    : value >= 9.95 || !data.tracked ? Math.round(value) + " m" : value.toFixed(value >= 0.995 ? 1 : 2) + " m";
  const degrees = value => value === null ? "–" : value.toFixed(Math.abs(value) >= 9.95 ? 0 : 1) + "°";
  const percent = value => value === null ? "–" : value > 0.9999 ? "> 99.99 %" : value > 0 && value < 0.0005 ? "< 0.1 %"
    : (100 * value).toFixed(value > 0.995 ? 2 : 1) + " %";
  const offBy = (scan, x, y) => scan.truth ? Math.hypot(x - scan.truth[0], y - scan.truth[1]) : null;
  const between = (a, b) => a === null || b === null ? null : ((a - b) % 360 + 540) % 360 - 180;
  const state = scan => {
    if (!scan.fix) return ["none", "no fix"];
    if (scan.error === null) return ["unscored", "fix"];
    return [data.classes.find(c => scan.error <= c.limit || c.limit === null).name, "fix, " + metres(scan.error) + " off"];
  };

  // A pointer of a given size that looks along a heading, counter-clockwise from the right.
  const pointer = (x, y, heading, size, attributes) => make("path", { d: "M1 0L-.75.66L-.35 0L-.75-.66Z",
    "vector-effect": "non-scaling-stroke", ...attributes, transform: `translate(${x} ${y}) rotate(${-heading}) scale(${size})` });
  const ellipse = (x, y, [a, b, angle], attributes) => make("ellipse", { cx: 0, cy: 0, rx: a, ry: b, ...attributes,
    transform: `translate(${x} ${y}) rotate(${angle})` });

  // All marks of a scan, drawn with so many metres to a pixel.
  function marksOf(scan, px) {
    const marks = [];
    if (scan.ellipse && scan.at) marks.push(ellipse(...scan.at, scan.ellipse, { class: "ellipse", "stroke-width": 1.4 * px }));
    const candidates = layers.candidates ? scan.candidates.slice(0, data.shown) : [];
    for (let i = candidates.length - 1; i >= 0; i--) {
      const c = candidates[i];
      const half = 9 * px;
      marks.push(make("rect", { class: i ? "candidate" : "candidate first", x: c[0] - half, y: c[1] - half,
        width: 2 * half, height: 2 * half, rx: 3 * px, "stroke-width": (i ? 1.2 : 2.4) * px }));
      marks.push(make("text", { x: c[0], y: c[1] + 4.2 * px, "font-size": 11.5 * px, "stroke-width": 2.6 * px,
        "text-anchor": "middle" }, i + 1));
    }
    const aligned = layers.aligned && scan.aligned ? scan.aligned : [];
    for (let i = aligned.length - 1; i >= 0; i--) {
      const [x, y, heading] = aligned[i];
      marks.push(pointer(x, y, heading, (i ? 8 : 11) * px, { class: i ? "alignedpose" : "alignedpose first" }));
    }
    const hypotheses = layers.hypotheses && scan.hypotheses ? scan.hypotheses : [];
    for (let i = hypotheses.length - 1; i >= 0; i--) {
      const [x, y, heading, belief, a, b, angle] = hypotheses[i];
      if (a !== null) marks.push(ellipse(x, y, [a, b, angle], { class: "hypothesisellipse", "stroke-width": 1.3 * px }));
      marks.push(pointer(x, y, heading, 11 * px, { class: "hypothesis" }));
      if (hypotheses.length > 1) marks.push(make("text", { class: "label", x: x + 13 * px, y: y - 9 * px,
        "font-size": 12 * px, "stroke-width": 2.8 * px }, percent(belief)));
    }
    if (scan.truth && scan.at) marks.push(make("line", { class: "tie", x1: scan.truth[0], y1: scan.truth[1],
      x2: scan.at[0], y2: scan.at[1], "stroke-width": 1.6 * px }));
    if (scan.at && data.tracked && scan.heading !== null) marks.push(pointer(...scan.at, scan.heading, 9 * px,
      { class: "fixpose " + state(scan)[0] }));
    else if (scan.at) marks.push(make("circle", { class: "fixdot " + state(scan)[0], cx: scan.at[0], cy: scan.at[1],
      r: 7 * px, style: `stroke-width:${1.6 * px}px;stroke:#fff` }));
    if (scan.truth) {
      const [x, y] = scan.truth;
      marks.push(make("circle", { class: "here", cx: x, cy: y, r: (data.tracked ? 14 : 10) * px, "stroke-width": 3 * px }));
      if (data.tracked && scan.trueHeading !== null) {
        const angle = scan.trueHeading * Math.PI / 180;
        const [dx, dy] = [Math.cos(angle) * px, -Math.sin(angle) * px];
        marks.push(make("line", { class: "here", x1: x + 14 * dx, y1: y + 14 * dy, x2: x + 24 * dx, y2: y + 24 * dy,
          "stroke-width": 3 * px }));
      }
    }
    return marks;
  }

  function drawMap(scan) {
    overlay.replaceChildren(...marksOf(scan, pixel()));
  }

  function drawCloseup(scan) {
    const first = (scan.hypotheses || [])[0];
    const middle = scan.truth || scan.at || (first ? first.slice(0, 2) : null);
    closeup.classList.toggle("off", !data.tracked || !middle);
    if (!data.tracked || !middle) return;
    const reach = Math.max(scan.error || 0, scan.ellipse ? scan.ellipse[0] : first ? first[4] || 0 : 0);
    const half = [8, 15, 30, 60].find(choice => choice >= 1.3 * reach) || 60;
    const px = 2 * half / 318;
    closeup.setAttribute("viewBox", `${middle[0] - half} ${middle[1] - half} ${2 * half} ${2 * half}`);
    const length = half > 20 ? 20 : half > 10 ? 5 : 2;
    const [left, base] = [middle[0] - half + 12 * px, middle[1] + half - 12 * px];
    closeup.replaceChildren(make("use", { href: "#picture" }), ...marksOf(scan, px),
      make("path", { d: `M${left} ${base - 5 * px}v${5 * px}h${length}v${-5 * px}`, fill: "none", stroke: "#fff",
        "stroke-width": 2 * px }),
      make("text", { x: left + length / 2, y: base - 6 * px, "font-size": 12 * px, "stroke-width": 3 * px,
        "text-anchor": "middle" }, length + " m"));
  }

  const element = (name, text, css) => {
    const e = document.createElement(name);
    if (text !== undefined) e.textContent = text;
    if (css) e.className = css;
    return e;
  };

  // A table that keeps open or closed from scan to scan.
  function fold(name, title, heads, rows, hint) {
    const scroll = element("div", undefined, "scroll");
    const table = element("table");
    const head = element("tr");
    for (const text of heads) head.append(element("th", text));
    table.append(head);
    for (const cells of rows) {
      const row = element("tr");
      for (const cell of cells) row.append(element("td", cell));
      table.append(row);
    }
    scroll.append(table);
    const parts = [scroll];
    if (hint) parts.push(element("p", hint, "hint"));
    if (!data.tracked) return parts;
    const details = element("details");
    details.open = open[name];
    details.addEventListener("toggle", () => { open[name] = details.open; });
    details.append(element("summary", `${title} (${rows.length})`), ...parts);
    return [details];
  }

  function drawPanel(scan) {
    const [kind, words] = state(scan);
    const title = element("h3", `Scan ${scan.number + 1} · ${scan.t.toFixed(1)} s`);
    const status = element("p");
    const chip = element("span", undefined, "state");
    chip.append(element("i", undefined, "key " + kind), element("span", words));
    status.append(chip);
    if (scan.state) {
      const track = element("span", undefined, "state");
      track.append(element("i", undefined, "key state-" + scan.state), element("span", data.states[scan.state]));
      status.prepend(track);
    }
    const reason = element("p", data.reasons[scan.reason], "hint");
    panel.replaceChildren(title, status, reason);
    if (data.tracked) {
      const facts = [];
      if (scan.belief !== null) facts.push(`${percent(scan.belief)} probability of an error below 10 m`);
      if (scan.ellipse) facts.push(`95 % within ${metres(scan.ellipse[0])}`);
      if (scan.turned !== null) facts.push(`heading error ${degrees(Math.abs(scan.turned))}`);
      if (scan.headingStd !== null) facts.push(`2 sigma of the heading ${degrees(2 * scan.headingStd)}`);
      if (facts.length) panel.append(element("p", facts.join(" · "), "hint"));
    }
    if (scan.latency !== null) panel.append(element("p", `${scan.latency.toFixed(1)} ms from scan to estimate`, "hint"));
    const poses = rows => rows.map((row, i) => [i + 1, percent(row[3]), metres(offBy(scan, row[0], row[1])),
      degrees(between(row[2], scan.trueHeading))]);
    const heads = ["#", "belief", "error", "Δ heading"];
    const source = s => s === data.exhaustive ? "map" : s < 0 ? `hypothesis ${-s}` : `square ${s + 1}`;
    if (scan.hypotheses && scan.hypotheses.length) panel.append(...fold("hypotheses", "Hypotheses", heads, poses(scan.hypotheses)));
    if (scan.aligned && scan.aligned.length) panel.append(...fold("aligned", "Aligned poses of this scan",
      [...heads, "found at"], poses(scan.aligned).map((row, i) => [...row, source(scan.aligned[i][4])])));
    if (!scan.candidates.length) return;
    const rows = scan.candidates.slice(0, data.shown).map((c, i) => [i + 1, c[2] === null ? "–" : c[2].toFixed(3),
      c[3] === null ? "–" : (100 * c[3]).toFixed(1) + " %", metres(offBy(scan, c[0], c[1]))]);
    const hint = scan.candidates.length > data.shown || data.more
      ? `The first ${data.shown} of ${data.top} candidates; all are in estimates.csv.` : "";
    panel.append(...fold("candidates", "Retrieved squares", ["#", "descriptor distance", "belief", "error"], rows, hint));
  }

  function drawCursor(scan) {
    for (const chart of charts) {
      let cursor = chart.querySelector(".cursor");
      if (!cursor) { cursor = make("line", { class: "cursor", y1: chart.dataset.top, y2: chart.dataset.bottom }); chart.append(cursor); }
      const x = +chart.dataset.left + (data.duration ? scan.t / data.duration : 0) * (chart.dataset.right - chart.dataset.left);
      cursor.setAttribute("x1", x); cursor.setAttribute("x2", x);
    }
  }

  function select(i) {
    index = Math.min(scans.length - 1, Math.max(0, i));
    slider.value = index;
    const scan = scans[index];
    keepInView(scan);
    drawMap(scan); drawCloseup(scan); drawPanel(scan); drawCursor(scan);
  }

  // Of a map that is zoomed in, the part that shows the scan.
  function keepInView(scan) {
    const at = scan.truth || scan.at;
    if (!at || view.width >= all.width - 1e-6) return;
    const margin = 0.12 * view.width;
    if (at[0] < view.x + margin || at[0] > view.x + view.width - margin || at[1] < view.y + margin || at[1] > view.y + view.height - margin)
      setView({ width: view.width, x: at[0] - view.width / 2, y: at[1] - view.height / 2 });
  }

  function play(on) {
    clearInterval(timer); timer = 0;
    document.getElementById("play").textContent = on ? "❚❚" : "▶";
    document.getElementById("play").setAttribute("aria-label", on ? "Pause" : "Play");
    if (on) timer = setInterval(() => index + 1 < scans.length ? select(index + 1) : play(false), 100);
  }

  function setView(next) {
    const width = Math.min(all.width, Math.max(all.width / 40, next.width));
    const height = width * all.height / all.width;
    view = { width, height,
      x: Math.min(all.x + all.width - width, Math.max(all.x, next.x)),
      y: Math.min(all.y + all.height - height, Math.max(all.y, next.y)) };
    svg.setAttribute("viewBox", `${view.x} ${view.y} ${view.width} ${view.height}`);
    document.getElementById("marks").style.setProperty("--px", pixel());
    drawMap(scans[index]);
  }
  const zoom = (factor, x, y) => setView({ width: view.width * factor, x: x - (x - view.x) * factor, y: y - (y - view.y) * factor });
  const centre = () => scans[index].truth || scans[index].at || [view.x + view.width / 2, view.y + view.height / 2];
  const place = event => {
    const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
    return [point.x, point.y];
  };

  document.getElementById("zoom-in").onclick = () => zoom(1 / 1.6, ...centre());
  document.getElementById("zoom-out").onclick = () => zoom(1.6, ...centre());
  document.getElementById("zoom-all").onclick = () => setView({ ...all });
  document.getElementById("previous").onclick = () => { play(false); select(index - 1); };
  document.getElementById("next").onclick = () => { play(false); select(index + 1); };
  document.getElementById("play").onclick = () => { if (!timer && index === scans.length - 1) select(0); play(!timer); };
  slider.oninput = () => { play(false); select(+slider.value); };
  svg.addEventListener("wheel", event => { if (!event.ctrlKey && !event.metaKey) return; event.preventDefault(); zoom(event.deltaY < 0 ? 1 / 1.25 : 1.25, ...place(event)); }, { passive: false });

  let drag = null;
  svg.addEventListener("pointerdown", event => { drag = { at: place(event), moved: false, id: event.pointerId }; });
  svg.addEventListener("pointermove", event => {
    if (!drag || view.width >= all.width - 1e-6) return;
    const [x, y] = place(event);
    if (!drag.moved && Math.hypot(x - drag.at[0], y - drag.at[1]) < 5 * pixel()) return;
    if (!drag.moved) { drag.moved = true; svg.setPointerCapture(drag.id); }
    setView({ width: view.width, x: view.x + drag.at[0] - x, y: view.y + drag.at[1] - y });
  });
  svg.addEventListener("pointerup", event => {
    const dragged = drag && drag.moved;
    drag = null;
    if (dragged) return;
    const [x, y] = place(event);
    let best = -1, least = 40 * pixel();
    scans.forEach((scan, i) => {
      for (const at of [scan.truth, scan.at]) {
        if (!at) continue;
        const distance = Math.hypot(at[0] - x, at[1] - y);
        if (distance < least) { least = distance; best = i; }
      }
    });
    if (best >= 0) { play(false); select(best); }
  });
  svg.addEventListener("pointercancel", () => { drag = null; });

  for (const box of document.querySelectorAll("input[data-layer]")) box.addEventListener("change", () => {
    layers[box.dataset.layer] = box.checked;
    drawMap(scans[index]); drawCloseup(scans[index]);
  });

  for (const chart of charts) chart.addEventListener("click", event => {
    const box = chart.getBoundingClientRect();
    const x = (event.clientX - box.left) / box.width * chart.viewBox.baseVal.width;
    const t = (x - chart.dataset.left) / (chart.dataset.right - chart.dataset.left) * data.duration;
    let best = 0;
    scans.forEach((scan, i) => { if (Math.abs(scan.t - t) < Math.abs(scans[best].t - t)) best = i; });
    play(false); select(best);
  });
  document.addEventListener("keydown", event => {
    if ((event.target instanceof Element && event.target.closest("input, button, a")) || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === "ArrowRight") { play(false); select(index + 1); }
    else if (event.key === "ArrowLeft") { play(false); select(index - 1); }
    else return;
    event.preventDefault();
  });
  addEventListener("resize", () => setView(view));

  const asked = /^#scan=(\d+)$/.exec(location.hash);
  const wanted = asked ? scans.findIndex(scan => scan.number >= asked[1] - 1) : data.start;
  setView({ ...all });
  select(wanted < 0 ? 0 : wanted);
})();
