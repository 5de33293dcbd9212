"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const scans = data.scans;
  const svg = document.getElementById("map");
  if (!scans.length || !svg) return;
  const overlay = document.getElementById("overlay");
  const slider = document.getElementById("slider");
  const panel = document.getElementById("scan");
  const charts = [...document.querySelectorAll("#errors")];
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
  const metres = value => value === null ? "–" : value >= 1000 ? (value / 1000).toFixed(1) + " km" : Math.round(value) + " m";
  const state = scan => {
    if (!scan.fix) return ["none", "no fix"];
    if (scan.error === null) return ["unscored", "fix"];
    return [data.classes.find(c => scan.error <= c.limit || c.limit === null).name, "fix, " + metres(scan.error) + " off"];
  };

  function drawMap(scan) {
    overlay.replaceChildren();
    const px = pixel();
    if (scan.ellipse && scan.at) {
      const [a, b, angle] = scan.ellipse;
      overlay.append(make("ellipse", { class: "ellipse", cx: 0, cy: 0, rx: a, ry: b, "stroke-width": 1.4 * px,
        transform: `translate(${scan.at[0]} ${scan.at[1]}) rotate(${angle})` }));
    }
    const candidates = scan.candidates.slice(0, data.shown);
    for (let i = candidates.length - 1; i >= 0; i--) {
      const c = candidates[i];
      const half = 9 * px;
      overlay.append(make("rect", { class: i ? "candidate" : "candidate first", x: c[0] - half, y: c[1] - half,
        width: 2 * half, height: 2 * half, rx: 3 * px, "stroke-width": (i ? 1.2 : 2.4) * px }));
      overlay.append(make("text", { x: c[0], y: c[1] + 4.2 * px, "font-size": 11.5 * px, "stroke-width": 2.6 * px,
        "text-anchor": "middle" }, i + 1));
    }
    if (scan.truth && scan.at) overlay.append(make("line", { class: "tie", x1: scan.truth[0], y1: scan.truth[1],
      x2: scan.at[0], y2: scan.at[1], "stroke-width": 1.6 * px }));
    if (scan.at) overlay.append(make("circle", { class: "fixdot " + state(scan)[0], cx: scan.at[0], cy: scan.at[1],
      r: 7 * px, style: `stroke-width:${1.6 * px}px;stroke:#fff` }));
    if (scan.truth) overlay.append(make("circle", { class: "here", cx: scan.truth[0], cy: scan.truth[1], r: 10 * px,
      "stroke-width": 3.2 * px }));
  }

  function drawPanel(scan) {
    const [kind, words] = state(scan);
    const element = (name, text, css) => {
      const e = document.createElement(name);
      if (text !== undefined) e.textContent = text;
      if (css) e.className = css;
      return e;
    };
    const title = element("h3", `Scan ${scan.number + 1} · ${scan.t.toFixed(1)} s`);
    const status = element("p");
    const chip = element("span", undefined, "state");
    chip.append(element("i", undefined, "key " + kind), element("span", words));
    status.append(chip);
    const reason = element("p", data.reasons[scan.reason], "hint");
    panel.replaceChildren(title, status, reason);
    if (scan.latency !== null) panel.append(element("p", `${scan.latency.toFixed(1)} ms from scan to answer`, "hint"));
    if (!scan.candidates.length) return;
    const scroll = element("div", undefined, "scroll");
    const table = element("table");
    const head = element("tr");
    for (const name of ["#", "descriptor distance", "belief", "off by"]) head.append(element("th", name));
    table.append(head);
    scan.candidates.slice(0, data.shown).forEach((c, i) => {
      const row = element("tr");
      const off = scan.truth ? Math.hypot(c[0] - scan.truth[0], c[1] - scan.truth[1]) : null;
      const cells = [i + 1, c[2] === null ? "–" : c[2].toFixed(3), c[3] === null ? "–" : (100 * c[3]).toFixed(1) + " %", metres(off)];
      for (const cell of cells) row.append(element("td", cell));
      table.append(row);
    });
    scroll.append(table);
    panel.append(scroll);
    if (scan.candidates.length > data.shown || data.more) panel.append(element("p", `The first ${data.shown} of ${data.top} candidates; all are in estimates.csv.`, "hint"));
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
    drawMap(scan); drawPanel(scan); drawCursor(scan);
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
