// Paints what viz/matrix.py computed: the scheduling matrix with a cursor, the noise of its row, the poses of its row.
// No logic of schedules here, no library, no network. Everything that moves with the row is drawn from `data`, so a drag
// waits for nobody. root.dataset.row, .rows, .facts and .poses ("yes", "waits", "no") are for tests.

export default {
  render({ model, el }) {
    const INK = "#1f2430";
    const WIDE = 1000, LEFT = 64, RIGHT = 12, HEAT = 230, BARS = 56, POSES = 130, BELOW = 20; // drawing units
    const TALL = 4 + HEAT + BARS + POSES + BELOW + 6;
    const PALE = [225, 205, 210]; // what noise turns limbs into

    function make(tag, parent, style, name) {
      const element = document.createElement(tag);
      Object.assign(element.style, style);
      if (name) element.className = name;
      parent.appendChild(element);
      return element;
    }

    const root = make("div", el, {
      background: "#fff", color: INK, padding: "8px 10px", font: "14px system-ui, sans-serif", maxWidth: "1100px",
    }, "fss-matrix"); // white on a dark theme too
    const facts = make("div", root, { display: "flex", flexWrap: "wrap", gap: "2px 30px", minHeight: "46px" }, "fss-facts");
    const problem = make("div", root, { color: "#b01428", fontSize: "15px", padding: "4px 0" }, "fss-problem");
    problem.setAttribute("role", "status");
    const canvas = make("canvas", root, { width: "100%", display: "block", cursor: "row-resize", touchAction: "none" });
    canvas.setAttribute("role", "img");
    const line = make("div", root, { padding: "2px 0 0 6%", minHeight: "1.4em", fontVariantNumeric: "tabular-nums" }, "fss-line");
    const heat = document.createElement("canvas"); // the matrix, one pixel a level
    let data, levels, colours, poses;

    function bytes(view) { // a DataView need not begin where its buffer does
      return new Uint8Array(view.buffer, view.byteOffset, view.byteLength);
    }

    function receive() {
      data = model.get("data");
      [levels, colours] = [bytes(data.levels), bytes(data.colours)];
      poses = new Int16Array(bytes(data.poses).slice().buffer); // (M,N,22,2) millimetres
      [heat.width, heat.height] = [data.latents, Math.max(data.rows, 1)];
      const pixels = heat.getContext("2d").createImageData(heat.width, heat.height);
      levels.forEach((level, i) => pixels.data.set([...colours.slice(3 * level, 3 * level + 3), 255], 4 * i));
      heat.getContext("2d").putImageData(pixels, 0, 0);
      facts.replaceChildren();
      for (const [name, value] of data.facts) {
        const fact = make("div", facts, {});
        make("div", fact, { fontSize: "20px", fontVariantNumeric: "tabular-nums" }).textContent = value;
        make("div", fact, { fontSize: "12px" }).textContent = name;
      }
      problem.textContent = data.problem;
      problem.style.display = data.problem ? "block" : "none";
      draw();
    }

    function colour(level) {
      return `rgb(${colours.slice(3 * level, 3 * level + 3).join(", ")})`;
    }

    function draw() {
      const row = Math.max(0, Math.min(model.get("row"), data.rows - 1));
      root.dataset.row = row;
      root.dataset.rows = data.rows;
      root.dataset.facts = data.facts.map((fact) => fact[1]).join(" ");
      root.dataset.poses = data.waits ? "waits" : poses.length ? "yes" : "no";
      line.textContent = data.lines[row] || "";
      canvas.setAttribute("aria-label", `Scheduling matrix; ${line.textContent}`);
      const zoom = window.devicePixelRatio || 1;
      [canvas.width, canvas.height] = [WIDE * zoom, TALL * zoom];
      const pen = canvas.getContext("2d");
      pen.scale(zoom, zoom);
      if (!data.rows) return;
      const wide = (WIDE - LEFT - RIGHT) / data.latents;
      const at = (n) => levels[row * data.latents + n];
      pen.font = "12px system-ui, sans-serif";
      pen.textBaseline = "middle";
      drawHeat(pen, row);
      const base = 4 + HEAT + BARS;
      const floor = base + POSES;
      label(pen, "noise k", base - BARS / 2);
      label(pen, "poses", floor - POSES / 2);
      for (let n = 0; n < data.latents; n++) drawBar(pen, n, at(n), wide, base);
      for (let n = 0; n < data.latents; n++) drawPose(pen, row, n, at(n), LEFT + (n + 0.5) * wide, floor);
      pen.fillStyle = INK;
      pen.textAlign = "center";
      for (let n = 0; n < data.latents; n++) {
        pen.fillText(wide > 55 ? `latent ${n}` : n, LEFT + (n + 0.5) * wide, floor + BELOW / 2 + 2);
      }
      if (data.waits) pen.fillText("sampling this schedule …", WIDE / 2, floor - POSES / 2);
    }

    function label(pen, text, y) {
      pen.fillStyle = INK;
      pen.textAlign = "right";
      pen.fillText(text, LEFT - 8, y);
    }

    function drawHeat(pen, row) {
      const high = HEAT / data.rows;
      pen.imageSmoothingEnabled = false; // or rows would run into each other
      pen.drawImage(heat, LEFT, 4, WIDE - LEFT - RIGHT, HEAT);
      pen.strokeStyle = INK;
      pen.lineWidth = 2;
      pen.strokeRect(LEFT - 3, 4 + row * high, WIDE - LEFT - RIGHT + 6, Math.max(high, 2));
      const cursor = 4 + (row + 0.5) * high;
      for (const [text, y] of [["0", 10], [String(data.rows - 1), HEAT - 2]]) {
        if (Math.abs(y - cursor) > 14) label(pen, text, y);
      }
      label(pen, `m = ${row}`, Math.max(10, Math.min(cursor, HEAT - 2)));
    }

    function drawBar(pen, n, level, wide, base) {
      const high = ((BARS - 16) * level) / data.steps + 2;
      pen.fillStyle = colour(level);
      pen.fillRect(LEFT + n * wide + 2, base - high, wide - 5, high);
      pen.strokeStyle = INK;
      pen.lineWidth = 1;
      pen.strokeRect(LEFT + n * wide + 2, base - high, wide - 5, high);
      pen.fillStyle = INK;
      pen.textAlign = "center";
      pen.fillText(level, LEFT + (n + 0.5) * wide, base - high - 7);
    }

    function drawPose(pen, row, n, level, middle, floor) {
      if (!poses.length) return;
      const first = 44 * (row * data.latents + n); // 22 joints of two numbers
      const scale = POSES / 2300;
      const place = (j) => [middle + poses[first + 2 * j] * scale, floor - 8 - poses[first + 2 * j + 1] * scale];
      const share = (0.86 * level) / data.steps;
      pen.lineCap = "round";
      pen.lineWidth = 3;
      const faded = (own) => `rgb(${own.map((value, i) => Math.round(value + (PALE[i] - value) * share)).join(", ")})`;
      for (const [parent, joint, ...own] of data.bones) {
        pen.strokeStyle = faded(own);
        pen.beginPath();
        pen.moveTo(...place(parent));
        pen.lineTo(...place(joint));
        pen.stroke();
        if (joint !== data.head) continue;
        pen.fillStyle = faded(own);
        pen.beginPath();
        pen.arc(...place(joint), 5, 0, 7);
        pen.fill();
      }
    }

    function point(event) { // the row under the pointer, if it is over the matrix
      const box = canvas.getBoundingClientRect();
      const y = ((event.clientY - box.top) / box.height) * TALL;
      return Math.floor(((y - 4) / HEAT) * data.rows);
    }

    function move(event) {
      if (!data.rows) return;
      model.set("row", Math.max(0, Math.min(point(event), data.rows - 1)));
      model.save_changes();
    }

    canvas.onpointerdown = (event) => {
      if (point(event) >= data.rows) return;
      canvas.setPointerCapture(event.pointerId);
      canvas.onpointermove = move;
      move(event);
    };
    canvas.onpointerup = canvas.onpointercancel = () => (canvas.onpointermove = null);
    model.on("change:data", receive);
    model.on("change:row", draw);
    receive();
    return () => {
      model.off("change:data", receive);
      model.off("change:row", draw);
    };
  },
};
