// The plane: the formation from above, to scale.
"use strict";

(() => {
  const ROOM_MM = 250, FAR_MM = 1200;  // around the path; robots up to so far from it are in the first view
  const TRAIL_POINTS = 500, SLIP_SHOWN_MM_S = 2, ARROW_S = 2.5;  // an arrow shows the way of so many seconds
  const view = { x: 0, y: 0, scale: 0.1, fitted: true };  // middle of the window, mm; px per mm; whole path
  Replay.view = view;

  Replay.fit = () => {
    let [left, right, low, high] = [Infinity, -Infinity, Infinity, -Infinity];
    const add = (x, y) => {
      left = Math.min(left, x); right = Math.max(right, x); low = Math.min(low, y); high = Math.max(high, y);
    };
    for (const run of Replay.runs) {
      for (let i = 0; i < run.leader.length; i += 2) add(run.leader[i], run.leader[i + 1]);
    }
    const [a, b, c, d] = [left - FAR_MM, right + FAR_MM, low - FAR_MM, high + FAR_MM];
    for (const run of Replay.runs) {
      for (let row = 0; row < run.rows; row += 5) {
        for (let robot = 0; robot < run.count; robot++) {
          const [x, y] = run.pose(row, robot);
          if (x > a && x < b && y > c && y < d) add(x, y);
        }
      }
      for (const wall of run.walls) for (const [x, y] of wall) if (x > a && x < b && y > c && y < d) add(x, y);
    }
    const ratio = (right - left + 2 * ROOM_MM) / (high - low + 2 * ROOM_MM);
    document.documentElement.style.setProperty("--ratio", Math.max(0.8, Math.min(2, ratio)).toFixed(3));
    const canvas = document.querySelector("canvas.plane");
    view.fitted = true;
    view.x = (left + right) / 2;
    view.y = (low + high) / 2;
    view.scale = Math.min(canvas.clientWidth / (right - left + 2 * ROOM_MM), canvas.clientHeight / (high - low + 2 * ROOM_MM));
  };

  Replay.sized = (canvas) => {
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    return [pen, width, height];
  };

  const roundBelow = (value) => {
    const decade = 10 ** Math.floor(Math.log10(value));
    return [5, 2, 1].map((digit) => digit * decade).find((one) => one <= value);
  };
  Replay.lengthText = (mm) => (mm >= 1000 ? `${mm / 1000} m` : `${mm} mm`);

  // Draws some runs into a canvas; of several, the first is solid and the others are outlines.
  Replay.drawPlane = (canvas, runs, state) => {
    const [pen, width, height] = Replay.sized(canvas);
    const px = (x, y) => [width / 2 + (x - view.x) * view.scale, height / 2 - (y - view.y) * view.scale];
    const shape = (points) => {
      pen.beginPath();
      points.forEach(([x, y], i) => (i ? pen.lineTo(...px(x, y)) : pen.moveTo(...px(x, y))));
      pen.closePath();
    };
    const dark = Replay.dark();
    pen.fillStyle = Replay.css("plate");
    pen.fillRect(0, 0, width, height);

    // grid
    const square = roundBelow(130 / view.scale);
    pen.strokeStyle = Replay.css("faint");
    pen.lineWidth = 1;
    pen.beginPath();
    for (let x = Math.ceil((view.x - width / 2 / view.scale) / square) * square; px(x, 0)[0] < width; x += square) {
      pen.moveTo(px(x, 0)[0], 0); pen.lineTo(px(x, 0)[0], height);
    }
    for (let y = Math.ceil((view.y - height / 2 / view.scale) / square) * square; px(0, y)[1] > 0; y += square) {
      pen.moveTo(0, px(0, y)[1]); pen.lineTo(width, px(0, y)[1]);
    }
    pen.stroke();

    const first = runs[0];
    for (const patch of first.patches) {
      pen.fillStyle = patch.scale < 1 ? Replay.mixed("#56b4e9", dark ? 0.25 : 0.28) : Replay.mixed("#e69f00", 0.22);
      pen.beginPath();
      pen.arc(...px(patch.x_mm, patch.y_mm), patch.radius_mm * view.scale, 0, 2 * Math.PI);
      pen.fill();
      pen.fillStyle = Replay.css("soft");
      pen.font = "12px system-ui, sans-serif";
      pen.textAlign = "center";
      pen.fillText(`friction × ${+patch.scale.toPrecision(3)}`, ...px(patch.x_mm, patch.y_mm));
    }
    for (const wall of first.walls) {
      shape(wall);
      pen.fillStyle = dark ? "#5a5f66" : "#acafb4";
      pen.strokeStyle = dark ? "#9aa0a8" : "#686b70";
      pen.fill(); pen.stroke();
    }

    // the leader's path
    pen.strokeStyle = dark ? "#6a7078" : "#b3b7bc";
    pen.lineWidth = 1.5;
    pen.beginPath();
    for (let i = 0; i < first.leader.length; i += 2) {
      const at = px(first.leader[i], first.leader[i + 1]);
      if (i) pen.lineTo(...at); else pen.moveTo(...at);
    }
    pen.stroke();

    runs.forEach((run, number) => {
      const row = run.row(state.t);
      if (state.trail_s) trails(run, row);
      things(run, row);
      for (let robot = run.count - 1; robot >= 0; robot--) drawRobot(run, row, robot, number);
    });
    scaleBar();

    function trails(run, row) {
      const begin = run.row(Math.max(0, run.t[row] - state.trail_s));
      const every = Math.max(1, Math.ceil((row - begin) / TRAIL_POINTS));
      pen.lineCap = "round";
      for (let robot = 0; robot < run.count; robot++) {
        let step = -1;
        for (let k = begin; k < row; k += every) {
          const next = Math.min(k + every, row);
          const now = Replay.errorStep(run.at("position_error_mm", next, robot));
          if (now !== step) {
            if (step >= 0) pen.stroke();
            step = now;
            pen.beginPath();
            pen.moveTo(...px(run.at("x_mm", k, robot), run.at("y_mm", k, robot)));
            pen.strokeStyle = Replay.errors[step][dark ? "dark" : "light"];
            pen.lineWidth = 1.2 + 0.8 * step;
            pen.globalAlpha = 0.75;
          }
          pen.lineTo(...px(run.at("x_mm", next, robot), run.at("y_mm", next, robot)));
        }
        if (step >= 0) pen.stroke();
        pen.globalAlpha = 1;
      }
    }

    function things(run, row) {
      run.things.forEach((thing, i) => {
        const [x, y, angle] = [0, 1, 2].map((k) => run.objects[(row * run.things.length + i) * 3 + k]);
        const [cos, sin] = [Math.cos(angle), Math.sin(angle)];
        shape(thing.points.map(([a, b]) => [x + a * cos - b * sin, y + a * sin + b * cos]));
        pen.fillStyle = run.palette[thing.kind];
        pen.strokeStyle = run.palette[`${thing.kind}_edge`];
        pen.lineWidth = 1.5;
        pen.fill(); pen.stroke();
      });
    }

    // Points (right, forward) of a body as points of the plane.
    function placed(points, [x, y, theta]) {
      const [cos, sin] = [Math.cos(theta), Math.sin(theta)];
      return points.map(([e, f]) => [x + e * cos - f * sin, y + e * sin + f * cos]);
    }

    function drawRobot(run, row, robot, number) {
      const body = run.robots[robot];
      const pose = run.pose(row, robot);
      const colour = Replay.themed(body.colour);
      const ghost = state.ghosts ? run.ghost(row, robot) : null;
      if (ghost) {
        shape(placed(body.outline, ghost));
        pen.setLineDash([4, 3]);
        pen.strokeStyle = colour;
        pen.lineWidth = 1.2;
        pen.stroke();
        pen.setLineDash([]);
      }
      const lost = run.lost(state.t, robot), touched = run.touched(state.t, robot);
      shape(placed(body.outline, pose));
      pen.fillStyle = Replay.css("plate");
      pen.globalAlpha = number ? 0.35 : 0.9;
      pen.fill();
      pen.globalAlpha = 1;
      pen.strokeStyle = lost || touched ? Replay.css("alarm") : colour;
      pen.lineWidth = lost || touched ? 3 : 2;
      if (number) pen.setLineDash([7, 3, 2, 3]);
      pen.stroke();
      pen.setLineDash([]);
      wheel(placed(body.left, pose), run.at("tyre_slip_left_mm_s", row, robot));
      wheel(placed(body.right, pose), run.at("tyre_slip_right_mm_s", row, robot));
      const [pivot] = placed([body.pivot], pose);
      wheel(placed(body.castor, [...pivot, pose[2] + run.at("castor_rad", row, robot)]), run.at("tyre_slip_castor_mm_s", row, robot));
      shape(placed(body.nose, pose));
      pen.fillStyle = colour;
      pen.globalAlpha = number ? 0.5 : 1;
      pen.fill();
      pen.globalAlpha = 1;
      if (state.arrows) slipArrow(run, row, robot, pose);
      label(run, robot, pose, number, lost || touched);
    }

    function wheel(points, slip) {
      const skids = slip > SLIP_SHOWN_MM_S;
      shape(points);
      pen.fillStyle = skids ? Replay.css("alarm") : dark ? "#c9cdd2" : "#30323a";
      pen.fill();
      if (skids) {
        pen.strokeStyle = Replay.css("alarm");
        pen.lineWidth = Math.min(1 + slip / 20, 5);
        pen.stroke();
      }
    }

    // The slip δ1 along the body and δ2 about it: how the body moves beside the rolling of its wheels.
    function slipArrow(run, row, robot, pose) {
      const along = run.at("slip_1_mm_s", row, robot), turn = run.at("slip_2_rad_s", row, robot);
      const body = run.robots[robot];
      pen.strokeStyle = pen.fillStyle = Replay.css("alarm");
      pen.lineWidth = 2;
      if (Math.abs(along) > 1) {
        const [[a, b], [c, d]] = placed([[0, 0], [0, along * ARROW_S]], pose);
        arrow(px(a, b), px(c, d));
      }
      if (Math.abs(turn) > 0.02) {
        const [x, y] = px(pose[0], pose[1]);
        const radius = 0.7 * body.radius_mm * view.scale;
        const from = -pose[2] - Math.PI / 2, to = from - Math.max(-2.5, Math.min(2.5, turn * ARROW_S));
        pen.beginPath();
        pen.arc(x, y, radius, from, to, turn > 0);
        pen.stroke();
        const tip = [x + radius * Math.cos(to), y + radius * Math.sin(to)];
        const back = turn > 0 ? to + 0.3 : to - 0.3;
        head([x + radius * Math.cos(back), y + radius * Math.sin(back)], tip);
      }
    }

    function arrow(from, to) {
      pen.beginPath();
      pen.moveTo(...from); pen.lineTo(...to);
      pen.stroke();
      head(from, to);
    }

    function head(from, to) {
      const angle = Math.atan2(to[1] - from[1], to[0] - from[0]);
      pen.beginPath();
      pen.moveTo(to[0] + 3 * Math.cos(angle), to[1] + 3 * Math.sin(angle));
      for (const side of [-2.5, 2.5]) pen.lineTo(to[0] + 7 * Math.cos(angle + side), to[1] + 7 * Math.sin(angle + side));
      pen.closePath();
      pen.fill();
    }

    function label(run, robot, pose, number, ended) {
      const words = (runs.length > 1 ? `${String.fromCharCode(65 + number)}` : "") + robot;
      const [x, y] = px(pose[0], pose[1]);
      const away = run.robots[robot].radius_mm * view.scale + 9;
      const inside = x > 0 && x < width && y > 0 && y < height;
      pen.font = "600 13px system-ui, sans-serif";
      pen.textAlign = "center";
      pen.textBaseline = "middle";
      pen.lineWidth = 3;
      pen.strokeStyle = Replay.css("plate");
      pen.fillStyle = ended ? Replay.css("alarm") : Replay.css("ink");
      if (inside) {
        pen.strokeText(words, x + 0.7 * away, y - 0.7 * away);
        pen.fillText(words, x + 0.7 * away, y - 0.7 * away);
        return;
      }
      // outside: its number at the edge, on the line from the middle
      const [dx, dy] = [x - width / 2, y - height / 2];
      const part = Math.min((width / 2 - 14) / Math.abs(dx || 1), (height / 2 - 14) / Math.abs(dy || 1));
      const at = [width / 2 + dx * part, height / 2 + dy * part];
      pen.strokeText(`→ ${words}`, ...at);
      pen.fillText(`→ ${words}`, ...at);
    }

    function scaleBar() {
      const length = roundBelow(Math.min(160, width / 3) / view.scale);
      const [x, y] = [14, height - 14];
      pen.strokeStyle = pen.fillStyle = Replay.css("ink");
      pen.lineWidth = 2;
      pen.beginPath();
      pen.moveTo(x, y - 4); pen.lineTo(x, y); pen.lineTo(x + length * view.scale, y); pen.lineTo(x + length * view.scale, y - 4);
      pen.stroke();
      pen.font = "12px system-ui, sans-serif";
      pen.textAlign = "left";
      pen.textBaseline = "alphabetic";
      pen.fillText(Replay.lengthText(length), x, y - 8);
    }
  };
})();
