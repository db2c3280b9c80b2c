// The plots: recorded columns over time. The lines are drawn once into a picture of their own, the cursor in each frame.
"use strict";

(() => {
  const LEFT = 58, RIGHT = 10, TOP = 22, BOTTOM = 20;
  const DASHES = [[], [7, 3], [2, 3], [7, 3, 2, 3]];

  // What the plots show: of all robots, or of the chosen one.
  Replay.plots = [
    { name: "position error", unit: "mm", scale: "log", each: "position_error_mm", digits: 2 },
    { name: "time-gap error", unit: "s", scale: "symlog", linear: 0.01, each: "time_gap_error_s", followers: true, digits: 4 },
    {
      name: "wheel torques", short: "torques", unit: "N·mm", scale: "linear", digits: 1, limit: "limit_Nmm",
      lines: [["left", "torque_l_Nmm", 0], ["right", "torque_r_Nmm", 1]],
    },
    {
      name: "slip δ₁, along the body", short: "slip δ₁", unit: "mm/s", scale: "linear", digits: 1,
      lines: [["true", "slip_1_mm_s", 0], ["estimated", "estimated_slip_1_mm_s", 1]],
    },
    {
      name: "slip δ₂, about the vertical", short: "slip δ₂", unit: "rad/s", scale: "linear", digits: 3,
      lines: [["true", "slip_2_rad_s", 0], ["estimated", "estimated_slip_2_rad_s", 1]],
    },
  ];

  const lineColours = () => (Replay.dark() ? ["#e8eaed", "#ff8c42"] : ["#24262a", "#d55e00"]);

  // The lines of a plot for a run: their values by row, colour, dash and name.
  Replay.linesOf = (plot, run, chosen) => {
    if (plot.each) {
      const robots = [...Array(run.count).keys()].filter((robot) => !(plot.followers && robot === 0));
      return robots.map((robot) => ({
        name: `robot ${robot}`, robot, column: plot.each, bold: robot === chosen,
        colour: Replay.themed(run.robots[robot].colour), dash: DASHES[Math.floor(robot / 7) % 4],
      }));
    }
    const robot = Math.min(chosen, run.count - 1);
    return plot.lines
      .filter(([, column]) => run.columns[column])
      .map(([name, column, i]) => ({ name, robot, column, bold: false, colour: lineColours()[i], dash: DASHES[i] }));
  };

  // A defined value of a line; a time gap is not defined before one gap has passed.
  Replay.valueOf = (plot, run, line, row) =>
    plot.followers && run.t[row] < run.gap_s - 1e-6 ? NaN : run.at(line.column, row, line.robot);

  // The range that all runs of the page share, so that they can be compared.
  function rangeOf(plot, chosen) {
    let [low, high] = [Infinity, -Infinity];
    const some = [];
    for (const run of Replay.runs) {
      for (const line of Replay.linesOf(plot, run, chosen)) {
        for (let row = 0; row < run.rows; row++) {
          const value = Replay.valueOf(plot, run, line, row);
          if (value < low) low = value;
          if (value > high) high = value;
          if (row % 10 === 0) some.push(value);
        }
      }
    }
    if (!(low <= high)) return [0, 1];
    if (plot.scale === "log") {  // up to the largest, down to what 95 % of the values exceed
      some.sort((a, b) => a - b);
      return [Math.max(0.005, Math.min(some[Math.floor(some.length / 20)] / 2, high / 100)), Math.max(high, 0.1) * 1.5];
    }
    const most = Math.max(Math.abs(low), Math.abs(high), 1e-9);
    if (plot.limit) {
      const limit = Replay.runs[0].robots[Math.min(chosen, Replay.runs[0].count - 1)][plot.limit];
      return [-Math.max(most, limit) * 1.25, Math.max(most, limit) * 1.25];
    }
    const room = 0.08 * (high - low || most);
    return [low - room, high + room];
  }

  function scaleOf(plot, [low, high]) {
    if (plot.scale === "log") return (value) => Math.log(Math.max(value, low) / low) / Math.log(high / low);
    if (plot.scale === "symlog" && high - low > 20 * plot.linear) {
      const bent = (value) => Math.asinh(value / plot.linear);
      return (value) => (bent(value) - bent(low)) / (bent(high) - bent(low));
    }
    return (value) => (value - low) / (high - low);
  }

  function ticksOf(plot, [low, high]) {
    if (plot.scale === "log") {
      const out = [];
      for (let k = Math.ceil(Math.log10(low) - 1e-9); k <= Math.log10(high); k++) out.push(10 ** k);
      return out;
    }
    if (plot.scale === "symlog" && high - low > 20 * plot.linear) {
      const sizes = [1, 10, 100, 1000].map((one) => +(one * plot.linear).toPrecision(3));
      return [...sizes.map((one) => -one), 0, ...sizes].filter((one) => one >= low && one <= high);
    }
    const rough = (high - low) / 5;
    const decade = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map((digit) => digit * decade).find((one) => one >= rough);
    const out = [];
    for (let k = Math.ceil(low / step); k * step <= high; k++) out.push(k * step);
    return out;
  }

  const numberText = (value) => `${+value.toPrecision(4)}`.replace("-", "−");

  class Plot {
    constructor(plot, run, canvas) {
      Object.assign(this, { plot, run, canvas });
      this.picture = document.createElement("canvas");
      this.key = "";
    }

    x(t, width) { return LEFT + (t / Replay.end) * (width - LEFT - RIGHT); }

    timeAt(px) {
      const width = this.canvas.clientWidth;
      return Math.max(0, Math.min(Replay.end, ((px - LEFT) / (width - LEFT - RIGHT)) * Replay.end));
    }

    draw(state) {
      const [pen, width, height] = Replay.sized(this.canvas);
      const key = [width, height, Replay.dark(), state.chosen, window.devicePixelRatio].join();
      if (key !== this.key) this.drawLines(state, width, height, key);
      pen.save();
      pen.setTransform(1, 0, 0, 1, 0, 0);
      pen.clearRect(0, 0, this.canvas.width, this.canvas.height);
      pen.drawImage(this.picture, 0, 0);
      pen.restore();
      const row = this.run.row(state.t);
      const x = this.x(this.run.t[row], width);
      this.cursor = { t: this.run.t[row], x };
      pen.strokeStyle = Replay.css("accent");
      pen.lineWidth = 1.5;
      pen.beginPath();
      pen.moveTo(x, TOP); pen.lineTo(x, height - BOTTOM);
      pen.stroke();
      for (const line of this.lines) {
        const value = Replay.valueOf(this.plot, this.run, line, row);
        if (Number.isNaN(value)) continue;
        pen.fillStyle = line.colour;
        pen.beginPath();
        pen.arc(x, this.y(value, height), 3, 0, 2 * Math.PI);
        pen.fill();
      }
      this.writeValues(pen, row, width);
    }

    y(value, height) { return height - BOTTOM - Math.max(0, Math.min(1, this.scale(value))) * (height - TOP - BOTTOM); }

    writeValues(pen, row, width) {
      pen.font = "12px system-ui, sans-serif";
      pen.textBaseline = "alphabetic";
      pen.textAlign = "right";
      let right = width - RIGHT;
      const shown = this.plot.each ? this.lines.filter((line) => line.bold) : this.lines;
      for (const line of [...shown].reverse()) {
        const value = Replay.valueOf(this.plot, this.run, line, row);
        const digits = Replay.fixed(value, this.plot.digits);
        const words = `${line.name} ${digits}`;
        pen.fillStyle = line.colour;
        pen.fillText(words, right, 14);
        right -= pen.measureText(words).width;
        pen.strokeStyle = line.colour;
        pen.lineWidth = 2;
        pen.setLineDash(line.dash);
        pen.beginPath();
        pen.moveTo(right - 24, 10); pen.lineTo(right - 5, 10);
        pen.stroke();
        pen.setLineDash([]);
        right -= 36;
      }
    }

    drawLines(state, width, height, key) {
      const { plot, run } = this;
      this.key = key;
      this.lines = Replay.linesOf(plot, run, state.chosen);
      const range = rangeOf(plot, state.chosen);
      this.scale = scaleOf(plot, range);
      this.picture.width = this.canvas.width;
      this.picture.height = this.canvas.height;
      const pen = this.picture.getContext("2d");
      const ratio = window.devicePixelRatio || 1;
      pen.setTransform(ratio, 0, 0, ratio, 0, 0);
      pen.fillStyle = Replay.css("plate");
      pen.fillRect(0, 0, width, height);
      pen.font = "12px system-ui, sans-serif";
      pen.lineWidth = 1;
      if (plot.limit) {
        const limit = run.robots[Math.min(state.chosen, run.count - 1)][plot.limit];
        pen.fillStyle = Replay.dark() ? "rgba(255,92,141,.16)" : "rgba(214,0,76,.09)";
        for (const [from, to] of [[limit, range[1]], [range[0], -limit]]) {
          const [above, below] = [this.y(to, height), this.y(from, height)];
          pen.fillRect(LEFT, above, width - LEFT - RIGHT, below - above);
        }
      }
      pen.textAlign = "right";
      pen.textBaseline = "middle";
      let last = null;
      const ticks = ticksOf(plot, range);
      for (const tick of ticks.includes(0) ? [0, ...ticks.filter((one) => one > 0), ...ticks.filter((one) => one < 0).reverse()] : ticks) {
        const y = this.y(tick, height);
        if (last !== null && tick * last >= 0 && Math.abs(y - this.y(last, height)) < 12) continue;
        if (tick < 0 && Math.abs(y - this.y(0, height)) < 12) continue;
        last = tick;
        pen.strokeStyle = Replay.css(tick === 0 ? "line" : "faint");
        pen.beginPath();
        pen.moveTo(LEFT, y); pen.lineTo(width - RIGHT, y);
        pen.stroke();
        pen.fillStyle = Replay.css("soft");
        pen.fillText(numberText(tick), LEFT - 6, y);
      }
      pen.textAlign = "center";
      pen.textBaseline = "alphabetic";
      const rough = Replay.end / Math.max(2, Math.floor(width / 110));
      const every = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000].find((one) => one >= rough) || rough;
      for (let t = 0; t <= Replay.end + 1e-6; t += every) {
        const x = this.x(t, width);
        pen.strokeStyle = Replay.css("faint");
        pen.beginPath();
        pen.moveTo(x, TOP); pen.lineTo(x, height - BOTTOM);
        pen.stroke();
        pen.fillStyle = Replay.css("soft");
        pen.fillText(`${numberText(t)} s`, Math.min(x, width - RIGHT - 12), height - 5);
      }
      pen.textAlign = "left";
      pen.fillStyle = Replay.css("ink");
      const who = plot.lines ? `, robot ${Math.min(state.chosen, run.count - 1)}` : "";
      const name = width < 520 && plot.short ? plot.short : plot.name;
      pen.fillText(`${name}${who} (${plot.unit})`, 4, 14);
      pen.save();
      pen.beginPath();
      pen.rect(LEFT, TOP - 1, width - LEFT - RIGHT, height - TOP - BOTTOM + 2);
      pen.clip();
      for (const line of [...this.lines].sort((a, b) => a.bold - b.bold)) this.drawLine(pen, line, width, height);
      pen.restore();
    }

    // A line with the least and the largest value in each column of pixels.
    drawLine(pen, line, width, height) {
      const { plot, run } = this;
      pen.strokeStyle = line.colour;
      pen.lineWidth = line.bold ? 2 : 1.1;
      pen.globalAlpha = plot.each && !line.bold ? 0.75 : 1;
      pen.setLineDash(line.dash);
      pen.beginPath();
      const columns = Math.max(1, Math.round(width - LEFT - RIGHT));
      const block = Math.max(1, Math.floor(run.rows / columns / 1.5));
      let drawing = false;
      for (let from = 0; from < run.rows; from += block) {
        let [low, high, lowAt, highAt] = [Infinity, -Infinity, from, from];
        for (let row = from; row < Math.min(from + block, run.rows); row++) {
          const value = Replay.valueOf(plot, run, line, row);
          if (value < low) { low = value; lowAt = row; }
          if (value > high) { high = value; highAt = row; }
        }
        if (!(low <= high)) { drawing = false; continue; }
        const ends = lowAt <= highAt ? [[lowAt, low], [highAt, high]] : [[highAt, high], [lowAt, low]];
        for (const [row, value] of block === 1 ? ends.slice(0, 1) : ends) {
          const [x, y] = [this.x(run.t[row], width), this.y(value, height)];
          if (drawing) pen.lineTo(x, y); else pen.moveTo(x, y);
          drawing = true;
        }
      }
      pen.stroke();
      pen.setLineDash([]);
      pen.globalAlpha = 1;
    }
  }
  Replay.Plot = Plot;
})();
