// The report of a benchmark: tables that sort and filter, a map of all cells, and charts with intervals.
(() => {
  "use strict";
  const data = JSON.parse(document.getElementById("data").textContent);
  const $ = (id) => document.getElementById(id);
  const SVG = "http://www.w3.org/2000/svg";

  // --- small helpers

  function made(name, properties = {}, ...inside) {
    const one = document.createElement(name);
    for (const [key, value] of Object.entries(properties))
      if (key === "class" || key.includes("-") || key === "scope") one.setAttribute(key, value);
      else one[key] = value;
    one.append(...inside);
    return one;
  }
  function drawn(name, attributes = {}, ...inside) {
    const one = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) one.setAttribute(key, value);
    one.append(...inside);
    return one;
  }
  const different = (values) => [...new Set(values)];
  const shown = (value, digits) =>
    value === null ? "–" : value.toFixed(Math.abs(value) >= 100 ? 0 : digits);
  const withUnit = (metric) => metric.title + (metric.unit ? ` (${metric.unit})` : "");
  const marked = (policy) => policy + (data.privileged.includes(policy) ? " (privileged)" : "");
  function fill(select, names, values = names) {
    select.replaceChildren(...names.map((name, i) => made("option", { textContent: name, value: values[i] })));
  }

  // --- copying of commands

  async function copied(text) {
    try {
      await navigator.clipboard.writeText(text);
      return true;
    } catch {
      const area = made("textarea", { value: text });
      document.body.append(area);
      area.select();
      const done = document.execCommand("copy");
      area.remove();
      return done;
    }
  }
  document.addEventListener("click", async (event) => {
    const button = event.target.closest(".copy");
    if (!button) return;
    const done = await copied(button.parentElement.querySelector("code").textContent);
    button.textContent = done ? "copied" : "select it";
    setTimeout(() => { button.textContent = "copy"; }, 1500);
  });

  // --- sorting

  const collator = new Intl.Collator("en", { numeric: true });
  function compare(a, b, down) {
    if (a === "" || b === "") return (a === "") - (b === "");  // what is undefined comes last
    const numbers = [Number(a), Number(b)];
    const order = numbers.some(Number.isNaN) ? collator.compare(a, b) : numbers[0] - numbers[1];
    return down ? -order : order;
  }
  for (const table of document.querySelectorAll("table.sortable")) {
    const heads = [...table.tHead.rows[0].cells];
    heads.forEach((head, column) => {
      head.querySelector("button").addEventListener("click", () => {
        const down = head.getAttribute("aria-sort") === "ascending";
        for (const other of heads) other.setAttribute("aria-sort", "none");
        head.setAttribute("aria-sort", down ? "descending" : "ascending");
        const value = (row) => row.cells[column].dataset.v;
        const rows = [...table.tBodies[0].rows];
        rows.sort((a, b) => compare(value(a), value(b), down));
        table.tBodies[0].append(...rows);
      });
    });
  }

  // --- filters of the large table

  const ALL = "all";
  const filters = { policy: $("by-policy"), task: $("by-task"), disturbance: $("by-disturbance") };
  function filter() {
    let count = 0;
    data.cells.forEach((cell, i) => {
      const fits = Object.entries(filters).every(([key, one]) => one.value === ALL || one.value === "=" + cell[key]);
      $(`cell-${i}`).hidden = !fits;
      count += fits;
    });
    $("shown").textContent = `${count} of ${data.cells.length} rows`;
  }
  for (const [key, one] of Object.entries(filters)) {
    const names = different(data.cells.map((cell) => cell[key]));
    fill(one, [ALL, ...names], [ALL, ...names.map((name) => "=" + name)]);
    one.addEventListener("change", filter);
  }
  filter();

  // --- what is chosen

  const task = $("task"), metric = $("metric"), disturbance = $("disturbance");
  const tasks = different(data.cells.map((cell) => cell.task));
  fill(task, tasks);
  fill(metric, data.metrics.map(withUnit), data.metrics.map((_, i) => String(i)));
  const ofTask = () => data.cells.filter((cell) => cell.task === task.value);
  function places() {
    const before = disturbance.value, names = different(ofTask().map((cell) => cell.place));
    fill(disturbance, names);
    if (names.includes(before)) disturbance.value = before;
  }

  // --- the map of policies and disturbances

  let pressed = null;
  function heat() {
    const at = Number(metric.value), what = data.metrics[at], cells = ofTask();
    const known = cells.map((cell) => cell.values[at][0]).filter((value) => value !== null);
    const log = what.log && Math.min(...known) > 0;
    const scale = log ? Math.log : (value) => value;
    let [low, high] = [Math.min(...known), Math.max(...known)];
    if (what.unit === "%" || what.key === "score") [low, high] = [0, 100];
    const worse = (value) => {
      const share = high > low ? (scale(value) - scale(low)) / (scale(high) - scale(low)) : 0;
      return what.good === "low" ? share : 1 - share;
    };
    const names = data.policies.filter((name) => cells.some((cell) => cell.policy === name));
    const longest = Math.max(...names.map((name) => marked(name).length));
    const head = names.map((name) => {
      const label = made("span", { textContent: marked(name) });
      label.style.height = `${Math.min(12, 1 + 0.58 * longest).toFixed(1)}em`;
      return made("th", { scope: "col" }, label);
    });
    const rows = different(cells.map((cell) => cell.place)).map((place) => {
      const row = names.map((name) => {
        const cell = cells.find((one) => one.policy === name && one.place === place);
        if (!cell) return made("td");
        const [value, from, to] = cell.values[at], button = made("button", { type: "button" });
        button.textContent = shown(value, what.digits);
        if (value !== null) button.style.setProperty("--v", worse(value).toFixed(3));
        const ends = from === null ? "" : `, 95 %: ${shown(from, what.digits)} to ${shown(to, what.digits)}`;
        button.title = `${name}, ${place}: ${what.title} ${shown(value, what.digits)} ${what.unit}${ends}`;
        button.setAttribute("aria-pressed", String(cell === pressed));
        button.dataset.cell = data.cells.indexOf(cell);
        return made("td", {}, button);
      });
      return made("tr", {}, made("th", { scope: "row", textContent: place, title: place }), ...row);
    });
    $("heat-map").replaceChildren(
      made("table", {}, made("thead", {}, made("tr", {}, made("td"), ...head)), made("tbody", {}, ...rows)));
    $("heat-title").textContent = `${task.value}: ${withUnit(what)}, ${what.key === "score" ? "interquartile mean" :
      what.key === "failed" ? "share" : "median, worst robot"} over the seeds`;
    const ends = what.good === "low" ? [low, high] : [high, low];
    $("heat-scale").replaceChildren(
      `${shown(ends[0], what.digits)} ${what.unit}, better`, made("i"),
      `${shown(ends[1], what.digits)} ${what.unit}, worse${log ? " (by ratios)" : ""}`);
  }
  function choose(i) {
    pressed = data.cells[i];
    const row = $(`cell-${i}`), table = row.closest("table"), heads = [...table.tHead.rows[0].cells];
    const name = (cell) => heads[cell.cellIndex].textContent;
    const parts = [made("p", {}, made("b", { textContent: `${marked(pressed.policy)}, ${pressed.task}, ${pressed.place}` }))];
    const numbers = [...row.cells].slice(3).filter((cell) => !cell.querySelector("details"));
    parts.push(made("p", { textContent: numbers.map((cell) => `${name(cell)} ${cell.textContent}`).join("; ") }));
    for (const cell of [...row.cells].filter((one) => one.querySelector("details"))) {
      const line = made("p", { textContent: `${name(cell)}: seed ${cell.dataset.v} ` });
      const link = cell.querySelector("a");
      if (link) line.append(link.cloneNode(true));
      parts.push(line);
      const command = cell.querySelector(".command");
      if (command) parts.push(command.cloneNode(true));
    }
    $("chosen").replaceChildren(...parts);
  }
  $("heat-map").addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (!button) return;
    choose(Number(button.dataset.cell));
    for (const one of $("heat-map").querySelectorAll("button"))
      one.setAttribute("aria-pressed", String(one === button));
    disturbance.value = pressed.place;
    chart();
  });

  // --- axes

  function ticksOf(low, high, log) {
    if (log) {
      const found = [];
      const steps = Math.log10(high / low) > 2.2 ? [1] : [1, 2, 5];
      for (let e = Math.floor(Math.log10(low)); e <= Math.ceil(Math.log10(high)); e++)
        for (const m of steps) {
          const value = m * 10 ** e;
          if (value >= low * 0.999 && value <= high * 1.001) found.push(value);
        }
      return found;
    }
    const raw = (high - low) / 5 || 1, power = 10 ** Math.floor(Math.log10(raw));
    const step = [1, 2, 5, 10].find((m) => m * power >= raw) * power, found = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) found.push(k * step);
    return found;
  }
  const tickText = (value) => String(Number(value.toPrecision(4)));
  const scaled = (low, high, log, from, to) => {
    const f = log ? Math.log : (value) => value, span = f(high) - f(low) || 1;
    return (value) => from + (to - from) * (f(value) - f(low)) / span;
  };
  function rangeOf(values, what) {
    if (what.unit === "%" || what.key === "score") return [0, 100, false];
    const low = Math.min(...values), high = Math.max(...values);
    if (low > 0 && high / low > 12) return [low / 1.15, high * 1.15, true];
    return [0, high * 1.05 || 1, false];
  }

  // --- one disturbance: a row for each policy, a dot with its interval

  const ROW = 36, TOP = 4, BOTTOM = 40;
  function widthOf(panels, count) {
    const whole = panels.clientWidth || 360, columns = Math.max(1, Math.min(count, Math.floor((whole + 16) / 352)));
    return Math.max(260, (whole - 16 * (columns - 1)) / columns);
  }
  function chart() {
    const cells = ofTask().filter((cell) => cell.place === disturbance.value);
    $("chart-title").textContent = `${task.value}, ${disturbance.value}: each policy with its 95 % interval`;
    const panels = $("chart-panels"), width = widthOf(panels, 3);
    panels.replaceChildren(...data.metrics.slice(0, 3).map((what, at) => {
      const values = cells.flatMap((cell) => cell.values[at]).filter((value) => value !== null);
      const [low, high, log] = values.length ? rangeOf(values, what) : [0, 1, false];
      const x = scaled(low, high, log, 8, width - 12), height = TOP + ROW * cells.length + BOTTOM;
      const svg = drawn("svg", { viewBox: `0 0 ${width} ${height}`, role: "img",
        "aria-label": `${what.title} of each policy; the numbers are in the tables` });
      for (const tick of ticksOf(low, high, log)) {
        svg.append(drawn("line", { x1: x(tick), x2: x(tick), y1: TOP, y2: height - BOTTOM, class: "grid" }));
        svg.append(drawn("text", { x: x(tick), y: height - BOTTOM + 15, class: "axis", "text-anchor": "middle" },
          tickText(tick)));
      }
      svg.append(drawn("text", { x: width / 2, y: height - 6, class: "axis", "text-anchor": "middle" },
        withUnit(what) + (log ? ", logarithmic" : "")));
      cells.forEach((cell, i) => {
        const [value, from, to] = cell.values[at], y = TOP + ROW * i + 25;
        const name = drawn("text", { x: 4, y: y - 10 }, marked(cell.policy));
        svg.append(name);
        if (value === null) return;
        if (from !== null) svg.append(drawn("line", { x1: x(from), x2: x(to), y1: y, y2: y, class: "range" }));
        const hollow = data.privileged.includes(cell.policy);
        svg.append(drawn("circle", { cx: x(value), cy: y, r: 5, class: hollow ? "hollow" : "dot" },
          drawn("title", {}, `${cell.policy}: ${shown(value, what.digits)} ${what.unit}`)));
      });
      return made("figure", {}, svg);
    }));
  }

  // --- lines: the sweep and the profiles

  const SHAPES = [
    (x, y) => drawn("circle", { cx: x, cy: y, r: 4 }),
    (x, y) => drawn("rect", { x: x - 3.5, y: y - 3.5, width: 7, height: 7 }),
    (x, y) => drawn("path", { d: `M${x},${y - 4.5}l4.5,8h-9z` }),
    (x, y) => drawn("path", { d: `M${x},${y - 5}l5,5l-5,5l-5,-5z` }),
    (x, y) => drawn("path", { d: `M${x},${y + 4.5}l4.5,-8h-9z` }),
  ];
  const colour = (i) => `var(--p${i % 7})`;
  const DASHES = ["", "6 3", "2 3"];
  const styled = (i) => `stroke:${colour(i)}` + (i >= 7 ? `;stroke-dasharray:${DASHES[Math.floor(i / 7) % 3]}` : "");
  function lines(title, xs, ys, xLabel, yLabel, curves, width) {
    const [left, right, top, bottom] = [46, 10, 8, 40], height = Math.max(230, Math.min(340, 0.62 * width));
    const x = scaled(...xs, left, width - right), y = scaled(...ys, height - bottom, top);
    const svg = drawn("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": title });
    for (const tick of ticksOf(...ys)) {
      svg.append(drawn("line", { x1: left, x2: width - right, y1: y(tick), y2: y(tick), class: "grid" }));
      svg.append(drawn("text", { x: left - 5, y: y(tick) + 4, class: "axis", "text-anchor": "end" }, tickText(tick)));
    }
    for (const tick of ticksOf(...xs))
      svg.append(drawn("text", { x: x(tick), y: height - bottom + 16, class: "axis", "text-anchor": "middle" },
        tickText(tick)));
    svg.append(drawn("text", { x: (left + width - right) / 2, y: height - 6, class: "axis", "text-anchor": "middle" },
      xLabel));
    svg.append(drawn("text", { x: 12, y: (top + height - bottom) / 2, class: "axis", "text-anchor": "middle",
      transform: `rotate(-90 12 ${(top + height - bottom) / 2})` }, yLabel));
    const clamp = (value) => Math.min(Math.max(value, ys[0]), ys[1]);
    for (const { i, points, every } of curves) {
      const group = drawn("g", { "data-policy": i }), known = points.filter((p) => p[1] !== null);
      const banded = known.filter((p) => p[2] !== null && p[2] !== undefined);
      if (banded.length > 1) {
        const edge = [...banded.map((p) => [p[0], p[2]]), ...[...banded].reverse().map((p) => [p[0], p[3]])];
        group.append(drawn("polygon", { class: "band", style: `fill:${colour(i)}`,
          points: edge.map(([a, b]) => `${x(a).toFixed(1)},${y(clamp(b)).toFixed(1)}`).join(" ") }));
      }
      group.append(drawn("polyline", { class: "line", style: styled(i),
        points: known.map((p) => `${x(p[0]).toFixed(1)},${y(clamp(p[1])).toFixed(1)}`).join(" ") }));
      known.forEach((p, k) => {
        if (k % every) return;
        const mark = SHAPES[i % SHAPES.length](x(p[0]), y(clamp(p[1])));
        mark.setAttribute("style", `fill:${colour(i)}`);
        mark.append(drawn("title", {}, `${data.policies[i]}: ${tickText(p[1])} at ${tickText(p[0])}`));
        group.append(mark);
      });
      svg.append(group);
    }
    return made("figure", {}, svg);
  }
  function legend(place, panels, present) {
    place.replaceChildren(...present.map((i) => {
      const mark = SHAPES[i % SHAPES.length](17, 7);
      mark.setAttribute("style", `fill:${colour(i)}`);
      const key = drawn("svg", { viewBox: "0 0 34 14", "aria-hidden": "true" },
        drawn("line", { x1: 1, x2: 33, y1: 7, y2: 7, class: "line", style: styled(i) }), mark);
      const button = made("button", { type: "button", "aria-pressed": "false" }, key, marked(data.policies[i]));
      button.addEventListener("click", () => {
        const on = button.getAttribute("aria-pressed") === "true";
        for (const one of place.children) one.setAttribute("aria-pressed", "false");
        if (!on) button.setAttribute("aria-pressed", "true");
        for (const group of panels.querySelectorAll("g[data-policy]"))
          group.classList.toggle("faded", !on && group.dataset.policy !== String(i));
      });
      return button;
    }));
  }
  function sweep() {
    if (!data.sweep) return;
    const panels = $("sweep-panels"), width = widthOf(panels, 2), figures = [], present = new Set();
    const chosen = ofTask().find((cell) => cell.place === disturbance.value);
    const cells = ofTask().filter((cell) => cell.disturbance === chosen.disturbance && cell.sweep !== null);
    const knob = cells.map((cell) => cell.sweep), xs = [Math.min(...knob), Math.max(...knob), data.sweep.log];
    $("sweep-title").textContent = `${task.value}, ${chosen.disturbance}, along ${data.sweep.label}; bands are 95 %. ` +
      "Press a policy to see it alone.";
    for (const [at, label, held] of [[1, "runs held (%)", true], [0, withUnit(data.metrics[0]), false]]) {
      const turned = (v) => held ? [100 - v[0], v[1] === null ? null : 100 - v[2], v[1] === null ? null : 100 - v[1]] : v;
      const curves = data.policies.map((name, i) => ({ i, every: 1, points: cells
        .filter((cell) => cell.policy === name).sort((a, b) => a.sweep - b.sweep)
        .map((cell) => [cell.sweep, ...turned(cell.values[at])]) })).filter((curve) => curve.points.length);
      for (const curve of curves) present.add(curve.i);
      const values = curves.flatMap((curve) => curve.points.map((p) => p[1])).filter((value) => value !== null);
      const ys = held ? [0, 100, false] : rangeOf(values, data.metrics[at]);
      figures.push(lines(`${label} along ${data.sweep.label}`, xs, ys, data.sweep.label, label + (ys[2] ? ", log" : ""),
        curves, width));
    }
    panels.replaceChildren(...figures);
    legend($("sweep-legend"), panels, [...present].sort((a, b) => a - b));
  }
  function profiles() {
    const panels = $("profile-panels");
    if (!panels) return;
    const curves = data.profiles.map((shares, i) => ({ i, every: 10,
      points: shares.map((share, k) => [100 * k / (shares.length - 1), 100 * share]) }));
    const width = Math.min(panels.clientWidth || 360, 640);
    panels.style.maxWidth = "640px";
    panels.replaceChildren(lines("Share of runs above each score", [0, 100, false], [0, 100, false], "score",
      "runs above that score (%)", curves, width));
    legend($("profile-legend"), panels, curves.map((curve) => curve.i));
  }

  // --- all of it, and again when the window changes its width

  task.addEventListener("change", () => { pressed = null; $("chosen").replaceChildren(); places(); heat(); chart(); sweep(); });
  metric.addEventListener("change", heat);
  disturbance.addEventListener("change", () => { chart(); sweep(); });
  places();
  heat();
  const redraw = () => { chart(); sweep(); profiles(); };
  redraw();
  let width = innerWidth, waiting = 0;
  addEventListener("resize", () => {
    if (innerWidth === width) return;
    width = innerWidth;
    clearTimeout(waiting);
    waiting = setTimeout(redraw, 150);
  });
})();
