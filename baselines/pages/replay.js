// The controls: one time for the plane and all plots.
"use strict";

(() => {
  const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4, 8, 16];
  const KEYS = [
    ["Space", "play or pause"], ["← →", "one step; with Shift one second"], ["Home End", "start, end"],
    ["[ ]", "slower, faster"], ["+ −", "zoom"], ["0", "whole path"], ["1 … 9", "follow robot 0 … 8, or stop"],
    ["T", "trails"], ["G", "ghosts: where each robot should be"], ["S", "slip arrows"], ["O", "overlay the runs"], ["D", "dark or light"],
  ];
  const TRAILS = [[0, "no trails"], [10, "trails of 10 s"], [30, "trails of 30 s"], [1e9, "whole trails"]];
  const state = {
    t: 0, playing: false, speed: 1, follow: null, chosen: 0, trail_s: 10, ghosts: true, arrows: true, overlay: false,
  };
  Replay.state = state;
  const { runs, view } = Replay;
  const step_s = runs[0].rows > 1 ? runs[0].t[1] - runs[0].t[0] : 0.02;
  const at = {};  // elements by name

  function element(name, attributes = {}, ...children) {
    const out = document.createElement(name);
    for (const key in attributes) {
      if (key.startsWith("on")) out.addEventListener(key.slice(2), attributes[key]);
      else out.setAttribute(key, attributes[key]);
    }
    out.append(...children);
    return out;
  }

  const button = (key, words, title, act) => (at[key] = element("button", { type: "button", title, onclick: act }, words));

  function select(key, title, options, chosen, act) {
    at[key] = element(
      "select", { title, "aria-label": title, onchange: (event) => act(event.target.value) },
      ...options.map(([value, words]) => element("option", { value }, words)),
    );
    at[key].value = `${chosen}`;
    return at[key];
  }

  // --- the page

  function build() {
    const most = Math.max(...runs.map((run) => run.count));
    const robots = [...Array(most).keys()];
    at.slider = element("input", {
      type: "range", min: 0, max: Replay.end, step: step_s, value: 0, "aria-label": "time",
      oninput: (event) => { pause(); seek(+event.target.value); },
    });
    at.time = element("output", { class: "time" });
    const bar = element(
      "div", { class: "bar screen" },
      button("play", "Play", "play or pause (Space)", toggle),
      select("speed", "speed", SPEEDS.map((one) => [one, `${one} ×`]), 1, (value) => { state.speed = +value; }),
      at.slider, at.time,
    );
    const more = element(
      "div", { class: "bar screen" },
      select("follow", "what the window follows", [["", "window fixed"], ...robots.map((i) => [i, `follow robot ${i}`])], "", (value) => follow(value === "" ? null : +value)),
      select("chosen", "robot of the plots below", robots.map((i) => [i, `plots of robot ${i}`]), 0, (value) => { state.chosen = +value; draw(); }),
      select("trail", "trails", TRAILS, 10, (value) => { state.trail_s = +value; draw(); }),
      button("ghosts", "Ghosts", "where each robot should be (G)", () => flip("ghosts")),
      button("arrows", "Slip", "arrows of the slip (S)", () => flip("arrows")),
      ...(runs.length > 1 ? [button("overlay", "Overlay", "all runs in one plane (O)", overlay)] : []),
      button("closer", "+", "closer (+)", () => zoom(1.3)),
      button("farther", "−", "farther (−)", () => zoom(1 / 1.3)),
      button("fit", "Whole path", "whole path (0)", fit),
      button("theme", "Theme", "dark or light (D)", theme),
    );
    at.runs = element("div", { class: "runs" });
    at.columns = runs.map((run, number) => column(run, number));
    at.runs.append(...at.columns.map((one) => one.box));
    at.runs.style.setProperty("--runs", runs.length);
    at.runs.classList.toggle("single", runs.length === 1);
    document.getElementById("replay").append(at.runs, legend(), keys());
    at.runs.before(bar, more);
  }

  function column(run, number) {
    const letter = runs.length > 1 ? `${String.fromCharCode(65 + number)}: ` : "";
    const plane = element("canvas", { class: "plane", role: "img", "aria-label": `the formation, ${run.name}`, tabindex: 0 });
    const count = element("p", { class: "count", "aria-live": "off" });
    const plots = Replay.plots.map((plot) => {
      const canvas = element("canvas", { class: "plot", role: "img", "aria-label": `${plot.name}, ${run.name}` });
      const shown = new Replay.Plot(plot, run, canvas);
      const scrub = (event) => {
        if (event.type === "pointerdown") canvas.setPointerCapture(event.pointerId);
        if (event.buttons & 1) { pause(); seek(shown.timeAt(event.offsetX)); }
      };
      canvas.addEventListener("pointerdown", scrub);
      canvas.addEventListener("pointermove", scrub);
      return shown;
    });
    const head = runs.length > 1 ? [element("h2", {}, letter + run.name)] : [];
    const rows = run.robots.map((robot, i) => {
      const swatch = element("span", { class: "swatch" });
      swatch.dataset.colour = robot.colour;
      const cells = [0, 1, 2, 3, 4].map(() => element("td"));
      return { swatch, cells, line: element("tr", {}, element("td", {}, swatch, ` ${i}`), ...cells) };
    });
    const heads = ["robot", "error, mm", "RMS, mm", "gap error, s", "torque at limit", ""];
    const table = element(
      "div", { class: "wide" },
      element("table", { class: "robots" }, element("thead", {}, element("tr", {}, ...heads.map((one) => element("th", {}, one)))), element("tbody", {}, ...rows.map((one) => one.line))),
    );
    drag(plane);
    const box = element(
      "section", { class: "run" }, ...head,
      element("div", {}, plane, count, table), element("div", {}, ...plots.map((one) => one.canvas)),
    );
    return { run, box, plane, count, rows, plots };
  }

  function legend() {
    at.steps = Replay.errors.map((step, i) => {
      const line = element("span", { class: "step" });
      line.style.height = `${1.2 + 0.8 * i}px`;
      const below = i ? Replay.errors[i - 1].most : 0;
      return [line, step, element("span", {}, step.most === Infinity ? `over ${below} mm` : `to ${step.most} mm`)];
    });
    return element(
      "div", { class: "legend" },
      element("span", {}, "trail: position error"), ...at.steps.flatMap(([line, , words]) => [line, words]),
      element("span", {}, "· dashed outline: where the robot should be (the leader: its reference; a follower: the place of its predecessor one time gap ago)"),
      element("span", {}, "· red wheel: it skids · red arrow: slip δ₁, δ₂, the way of 2.5 s"),
      element("span", {}, "· red outline: lost or touched"),
    );
  }

  function keys() {
    return element(
      "details", { class: "screen" }, element("summary", {}, "Keys and mouse"),
      element("p", {}, ...KEYS.flatMap(([key, words]) => [element("kbd", {}, key), ` ${words}   `])),
      element("p", {}, "Drag the plane to move it, use the wheel or two fingers to zoom, and drag in a plot to change the time."),
    );
  }

  // --- what the controls do

  function seek(t) { state.t = Math.max(0, Math.min(Replay.end, t)); draw(); }

  function pause() { state.playing = false; at.play.textContent = "Play"; }

  function toggle() {
    if (state.playing) { pause(); return; }
    if (state.t >= Replay.end - 1e-6) state.t = 0;
    state.playing = true;
    at.play.textContent = "Pause";
    before = null;
    requestAnimationFrame(frame);
  }

  let before = null;
  function frame(now) {
    if (!state.playing) return;
    if (before !== null) state.t = Math.min(Replay.end, state.t + Math.min((now - before) / 1000, 0.25) * state.speed);
    before = now;
    if (state.t >= Replay.end) pause();
    draw();
    if (state.playing) requestAnimationFrame(frame);
  }

  function flip(name) { state[name] = !state[name]; draw(); }

  function overlay() { state.overlay = !state.overlay; draw(); }

  function follow(robot) {
    state.follow = robot;
    if (robot !== null) view.fitted = false;
    at.follow.value = robot === null ? "" : `${robot}`;
    if (robot !== null) { state.chosen = robot; at.chosen.value = `${robot}`; }
    draw();
  }

  function zoom(factor, x = 0, y = 0) {  // about a point, mm from the middle
    const scale = Math.max(0.005, Math.min(20, view.scale * factor));
    const part = 1 - view.scale / scale;
    view.x += x * part;
    view.y += y * part;
    view.scale = scale;
    view.fitted = false;
    draw();
  }

  function fit() { follow(null); Replay.fit(); draw(); }

  function theme() {
    document.documentElement.dataset.theme = Replay.dark() ? "light" : "dark";
    draw();
  }

  function change(index) {
    state.speed = SPEEDS[Math.max(0, Math.min(SPEEDS.length - 1, index))];
    at.speed.value = `${state.speed}`;
  }

  function drag(canvas) {
    const pointers = new Map();
    const spread = () => { const [a, b] = [...pointers.values()]; return Math.hypot(a.x - b.x, a.y - b.y); };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, { x: event.offsetX, y: event.offsetY });
    });
    canvas.addEventListener("pointermove", (event) => {
      const last = pointers.get(event.pointerId);
      if (!last) return;
      const apart = pointers.size === 2 ? spread() : 0;
      pointers.set(event.pointerId, { x: event.offsetX, y: event.offsetY });
      if (pointers.size === 2) { zoom(spread() / (apart || 1)); return; }
      view.x -= (event.offsetX - last.x) / view.scale;
      view.y += (event.offsetY - last.y) / view.scale;
      view.fitted = false;
      if (state.follow !== null) follow(null);
      draw();
    });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      const x = (event.offsetX - canvas.clientWidth / 2) / view.scale;
      const y = -(event.offsetY - canvas.clientHeight / 2) / view.scale;
      zoom(Math.exp(-event.deltaY / 400), state.follow === null ? x : 0, state.follow === null ? y : 0);
    }, { passive: false });
  }

  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const tag = event.target.tagName;
    if (tag === "SELECT" || (tag === "BUTTON" && event.key === " ")) return;
    const number = "123456789".indexOf(event.key);
    const step = event.shiftKey ? 1 : step_s;
    const acts = {
      " ": toggle, ArrowLeft: () => { pause(); seek(state.t - step); }, ArrowRight: () => { pause(); seek(state.t + step); },
      Home: () => seek(0), End: () => { pause(); seek(Replay.end); },
      "[": () => change(SPEEDS.indexOf(state.speed) - 1), "]": () => change(SPEEDS.indexOf(state.speed) + 1),
      "+": () => zoom(1.3), "=": () => zoom(1.3), "-": () => zoom(1 / 1.3), "0": fit,
      t: () => { const i = TRAILS.findIndex(([one]) => one === state.trail_s); state.trail_s = TRAILS[(i + 1) % TRAILS.length][0]; at.trail.value = `${state.trail_s}`; draw(); },
      g: () => flip("ghosts"), s: () => flip("arrows"), d: theme, o: () => { if (runs.length > 1) overlay(); },
    };
    const act = number >= 0
      ? () => { if (number < runs[0].count) follow(state.follow === number ? null : number); }
      : acts[event.key] || acts[event.key.toLowerCase()];
    if (act) { event.preventDefault(); act(); }
  });

  // --- drawing

  function draw() {
    if (state.follow !== null) {
      const run = runs[0];
      [view.x, view.y] = run.pose(run.row(state.t), Math.min(state.follow, run.count - 1));
    }
    at.slider.value = state.t;
    at.time.textContent = `${state.t.toFixed(2)} s of ${+Replay.end.toFixed(2)} s`;
    for (const name of ["ghosts", "arrows", "overlay"]) if (at[name]) at[name].setAttribute("aria-pressed", state[name]);
    document.getElementById("replay").classList.toggle("overlaid", state.overlay);
    at.columns.forEach((one, number) => {
      if (!state.overlay) Replay.drawPlane(one.plane, [one.run], state);
      else if (number === 0) Replay.drawPlane(one.plane, runs, state);
      count(one);
      for (const plot of one.plots) plot.draw(state);
    });
    for (const [line, step] of at.steps) line.style.background = step[Replay.dark() ? "dark" : "light"];
  }
  Replay.draw = draw;

  function count({ run, count: words, rows }) {
    const row = run.row(state.t);
    const robots = [...Array(run.count).keys()];
    const lost = robots.filter((robot) => run.lost(state.t, robot)).length;
    const touched = robots.filter((robot) => run.touched(state.t, robot)).length;
    const rms = Math.max(...robots.map((robot) => run.rms(row, robot)));
    const since = row > run.row(run.settle_s) ? ` since ${+run.settle_s.toFixed(3)} s` : " so far";
    words.textContent = `worst error ${run.at("position_error_mm", row, run.worst(row)).toFixed(1)} mm, ` +
      `worst RMS${since} ${rms.toFixed(2)} mm, lost ${lost} of ${run.count}` + (touched ? `, touched ${touched}` : "") +
      (state.t > run.end + 1e-6 ? `; ended at ${+run.end.toFixed(2)} s` : "");
    rows.forEach(({ swatch, cells }, robot) => {
      swatch.style.background = Replay.themed(swatch.dataset.colour);
      const gap = run.t[row] < run.gap_s - 1e-6 || robot === 0 ? NaN : run.at("time_gap_error_s", row, robot);
      const texts = [
        run.at("position_error_mm", row, robot).toFixed(1), run.rms(row, robot).toFixed(2),
        Replay.fixed(gap, 3),
        `${Math.round(100 * run.at("saturation_fraction", row, robot))} %`,
        run.lost(state.t, robot) ? "lost" : run.touched(state.t, robot) ? "touched" : "",
      ];
      texts.forEach((text, i) => { if (cells[i].textContent !== text) cells[i].textContent = text; });
    });
  }

  build();
  Replay.columns = at.columns;  // the plane and the plots of each run
  Replay.fit();
  const asked = /[#&]t=([0-9.]+)/.exec(location.hash);
  if (asked) state.t = Math.min(+asked[1], Replay.end);
  const worst = runs[runs.length - 1];
  state.chosen = worst.worst(worst.rows - 1);
  at.chosen.value = `${state.chosen}`;
  draw();
  new ResizeObserver(() => { if (view.fitted) Replay.fit(); draw(); }).observe(at.runs);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  let shown;
  addEventListener("beforeprint", () => { shown = document.documentElement.dataset.theme; document.documentElement.dataset.theme = "light"; draw(); });
  addEventListener("afterprint", () => { if (shown) document.documentElement.dataset.theme = shown; else delete document.documentElement.dataset.theme; draw(); });
  if (!asked && !matchMedia("(prefers-reduced-motion: reduce)").matches) toggle();
})();
