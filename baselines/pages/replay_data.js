// The runs of the page: their columns as arrays, and the values at a time. Lengths in mm, angles in rad, times in s.
"use strict";
const Replay = {};

(() => {
  const MISSING = 65535;

  function bytesOf(text) {
    const raw = atob(text);
    const out = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) out[i] = raw.charCodeAt(i);
    return new DataView(out.buffer);
  }

  // A column as one array, row by row; a value that is missing is NaN.
  function decoded(column) {
    const view = bytesOf(column.bytes);
    if (!column.low) {
      const out = new Float32Array(view.byteLength / 4);
      for (let i = 0; i < out.length; i++) out[i] = view.getFloat32(4 * i, true);
      return out;
    }
    const out = new Float32Array(view.byteLength / 2);
    const robots = column.low.length;
    for (let i = 0; i < out.length; i++) {
      const code = view.getUint16(2 * i, true);
      const robot = i % robots;
      out[i] = code === MISSING ? NaN : column.low[robot] + column.step[robot] * code;
    }
    return out;
  }

  class Run {
    constructor(raw) {
      Object.assign(this, raw);
      this.count = raw.robots.length;
      this.t = decoded(raw.t_s);
      this.leader = decoded(raw.leader_mm);
      this.objects = raw.objects ? decoded(raw.objects) : null;
      this.columns = {};
      for (const name in raw.columns) this.columns[name] = decoded(raw.columns[name]);
      this.end = this.t[this.rows - 1];
      this.squares = this.runningSquares("position_error_mm");
    }

    // The last row at or before a time.
    row(t) {
      let low = 0, high = this.rows - 1;
      while (low < high) {
        const middle = (low + high + 1) >> 1;
        if (this.t[middle] <= t + 1e-6) low = middle; else high = middle - 1;
      }
      return low;
    }

    at(name, row, robot) {
      const column = this.columns[name];
      return column ? column[row * this.count + robot] : NaN;
    }

    pose(row, robot) {
      return [this.at("x_mm", row, robot), this.at("y_mm", row, robot), this.at("theta_rad", row, robot)];
    }

    // Where a robot should be: its predecessor's place one time gap ago; for the leader its reference.
    ghost(row, robot) {
      if (robot === 0) {
        return ["reference_x_mm", "reference_y_mm", "reference_theta_rad"].map((name) => this.at(name, row, 0));
      }
      const then = this.t[row] - this.gap_s;
      return then < -1e-6 ? null : this.pose(this.row(then), robot - 1);
    }

    // Sums of squares of a column from the start to each row.
    runningSquares(name) {
      const out = new Float64Array(this.rows * this.count);
      for (let i = 0; i < out.length; i++) {
        const value = this.columns[name][i];
        out[i] = (i < this.count ? 0 : out[i - this.count]) + value * value;
      }
      return out;
    }

    // Root mean square of the position error from the settle time to a row; from the start before it.
    rms(row, robot) {
      const settled = this.row(this.settle_s);
      const first = row > settled ? settled : 0;
      const before = first ? this.squares[(first - 1) * this.count + robot] : 0;
      return Math.sqrt((this.squares[row * this.count + robot] - before) / (row - first + 1));
    }

    lost(t, robot) { const at = this.robots[robot].lost_at_s; return at !== null && t >= at - 1e-6; }

    touched(t, robot) { const at = this.robots[robot].touched_at_s; return at !== null && t >= at - 1e-6; }

    worst(row) {
      let found = 0;
      for (let robot = 1; robot < this.count; robot++) {
        if (this.at("position_error_mm", row, robot) > this.at("position_error_mm", row, found)) found = robot;
      }
      return found;
    }
  }

  Replay.runs = JSON.parse(document.getElementById("data").textContent).runs.map((raw) => new Run(raw));
  Replay.end = Math.max(...Replay.runs.map((run) => run.end));

  // --- colours

  const parsed = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));
  Replay.dark = () => getComputedStyle(document.documentElement).colorScheme.includes("dark");
  Replay.css = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

  // A colour that stands out from the ground of the theme: dark ones are lightened on a dark ground.
  Replay.themed = (hex) => {
    const rgb = parsed(hex);
    const light = (0.2126 * rgb[0] + 0.7152 * rgb[1] + 0.0722 * rgb[2]) / 255;
    if (!Replay.dark() || light > 0.42) return hex;
    const part = light < 0.1 ? 0.85 : 0.45;
    return `rgb(${rgb.map((one) => Math.round(one + part * (255 - one))).join(",")})`;
  };

  // A number as text: a true minus, no −0.00, and a dash for what is not defined.
  Replay.fixed = (value, digits) => {
    if (Number.isNaN(value)) return "–";
    const text = value.toFixed(digits);
    return +text === 0 ? text.replace("-", "") : text.replace("-", "−");
  };

  Replay.mixed = (hex, part) => `rgba(${parsed(hex).join(",")},${part})`;

  // Position errors: from blue (small) through orange to red; a wider line says the same.
  Replay.errors = [
    { most: 1, light: "#0072b2", dark: "#56b4e9" }, { most: 3, light: "#4a7a96", dark: "#8fb8c9" },
    { most: 10, light: "#8a7f62", dark: "#c9bc92" }, { most: 30, light: "#d08a00", dark: "#f0b429" },
    { most: 100, light: "#d55e00", dark: "#ff8c42" }, { most: Infinity, light: "#b0003a", dark: "#ff5c8d" },
  ];
  Replay.errorStep = (error) => Replay.errors.findIndex((step) => !(error > step.most));
})();
