// The live stream: plays frames as they come, asks Python (viz/livestream.py) for more when few are left, and sends
// what is written in the box. No library, no network. It asks only while it plays and can be seen.
//
// For tests: .livestream (data-frame on show, data-prompt it hears, data-buffer frames left, data-playing "yes" or "no",
// data-heard the first frame that hears what was sent last), .livestream-prompt, .livestream-send, .livestream-start,
// .livestream-said, .livestream-acting, .livestream-canvas.

export default {
  render({ model, el }) {
    const COLOURS = { left: "#e07a1f", right: "#2563c9", middle: "#454b57" };
    const TRAIL = 160; // frames of the way behind it
    const plan = model.get("plan");
    const stride = 3 * plan.parents.length;
    const view = { yaw: 0.6, pitch: 0.24, distance: 4.2 };
    let frames = []; // poses of `stride` numbers; frames[0] is frame number `first`
    let first = 0;
    let told = [[0, plan.prompt]]; // [first frame that hears it, sentence]
    let now = 0; // the time on show, in frames
    let playing = false;
    let visible = true;
    let asked = false; // a chunk is on its way
    let lastTick = 0;
    let request = 0;

    // ---- the page --------------------------------------------------------------------------------------------------
    function make(tag, parent, style, name) {
      const element = document.createElement(tag);
      Object.assign(element.style, style || {});
      if (name) element.className = `livestream-${name}`;
      parent.appendChild(element);
      return element;
    }

    const root = make("div", el, { // white on a dark theme too
      background: "#fff", color: "#1f2430", padding: "8px 10px", font: "14px system-ui, sans-serif",
      boxSizing: "border-box", maxWidth: "960px", colorScheme: "light",
    });
    root.className = "livestream";
    const row = make("form", root, { display: "flex", gap: "8px", paddingBottom: "8px" });
    const box = make("input", row, {
      flex: "1", minWidth: "0", font: "inherit", padding: "5px 8px", border: "1px solid #9aa1ae", borderRadius: "5px",
      background: "#fff", color: "inherit",
    }, "prompt");
    box.type = "text";
    box.setAttribute("aria-label", "What to do next");
    box.placeholder = "what next? e.g. a person jumps twice";
    const style = { font: "inherit", padding: "5px 14px", borderRadius: "5px", border: "1px solid #9aa1ae", background: "#f5f6f8", color: "inherit", cursor: "pointer" };
    const send = make("button", row, style, "send");
    send.type = "submit";
    send.textContent = "send";
    const start = make("button", row, { ...style, minWidth: "5.5em" }, "start");
    start.type = "button";

    const stage = make("div", root, { position: "relative" });
    const canvas = make("canvas", stage, {
      width: "100%", height: "min(420px, 52vh)", borderRadius: "8px", background: "#f5f6f8", display: "block",
      cursor: "grab", touchAction: "none",
    }, "canvas");
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", "The skeleton, live. Drag to orbit, wheel to zoom");
    const acting = make("div", stage, { // over the floor, in front of the feet
      position: "absolute", left: "50%", bottom: "10px", transform: "translateX(-50%)", maxWidth: "92%",
      padding: "3px 12px", borderRadius: "12px", background: "rgba(255, 255, 255, 0.85)", textAlign: "center",
      fontSize: "16px", fontWeight: "600", pointerEvents: "none",
    }, "acting");
    const foot = make("div", root, {
      display: "flex", gap: "10px", alignItems: "center", flexWrap: "wrap", paddingTop: "8px",
      fontVariantNumeric: "tabular-nums",
    });
    const rail = make("div", foot, { width: "120px", height: "9px", background: "#dfe2e8", borderRadius: "4px", overflow: "hidden" });
    const fill = make("div", rail, { height: "100%", background: "#5b8c5a" });
    const clock = make("span", foot, { minWidth: "17em" });
    const said = make("span", foot, { flex: "1 1 14em", color: "#5b6270" }, "said");
    said.setAttribute("role", "status");

    // ---- frames in ---------------------------------------------------------------------------------------------------
    const last = () => first + frames.length - 1;
    const left = () => Math.max(last() - now, 0);

    function take(bytes, number) { // a DataView of float32, whose bytes may begin anywhere
      if (number <= last()) return; // another view asked for these too, and they are here
      if (number > last() + 1 && frames.length) [frames, first, now] = [[], number, number]; // a view that was away
      for (let at = 0; at + 4 * stride <= bytes.byteLength; at += 4 * stride) {
        const pose = new Float32Array(stride);
        for (let i = 0; i < stride; i++) pose[i] = bytes.getFloat32(at + 4 * i, true);
        frames.push(pose);
      }
      const old = Math.floor(now) - TRAIL - first;
      if (old > 0) [frames, first] = [frames.slice(old), first + old];
    }

    function onMessage(message, buffers) {
      if (message.kind === "frames") {
        asked = false;
        told = message.told;
        take(buffers[0], message.first);
      } else if (message.kind === "heard") {
        root.dataset.heard = message.first;
        const wait = (Math.max(message.first - now, 0) / plan.fps).toFixed(1);
        say(`sent at frame ${Math.floor(now)}, heard ${wait} s later, from frame ${message.first} on`);
      } else if (message.kind === "problem") {
        say(message.text, true);
        if (message.fatal) stop();
      }
      draw();
    }

    function say(text, wrong) {
      said.textContent = text; // as text, so a prompt can never become markup
      said.style.color = wrong ? "#b3261e" : "#5b6270";
    }

    function ask() {
      if (!playing || !visible || asked || left() >= plan.low) return;
      asked = true;
      model.send({ kind: "more" });
    }

    // ---- drawing -------------------------------------------------------------------------------------------------------
    function poseAt(time) {
      const at = Math.min(Math.max(time, first), last());
      const [a, b] = [frames[Math.floor(at) - first], frames[Math.min(Math.floor(at) + 1, last()) - first]];
      const part = at - Math.floor(at);
      return a.map((value, i) => value * (1 - part) + b[i] * part);
    }

    function camera(pose) { // turns about a point above the pelvis's place on the floor
      const [sy, cy, sp, cp] = [Math.sin(view.yaw), Math.cos(view.yaw), Math.sin(view.pitch), Math.cos(view.pitch)];
      const focal = Math.min(canvas.width, canvas.height) * 1.35;
      return (x, y, z) => {
        const [dx, dy, dz] = [x - pose[0], y - 0.75, z - pose[2]];
        const near = sy * dx + cy * dz;
        const away = view.distance - sp * dy - cp * near;
        const size = focal / Math.max(away, 0.05); // pixels a metre
        const across = canvas.width / 2 + (cy * dx - sy * dz) * size;
        return { x: across, y: canvas.height / 2 - (cp * dy - sp * near) * size, away, size };
      };
    }

    function stroke(pen, pairs, colour, width) {
      pen.strokeStyle = colour;
      pen.lineWidth = width;
      pen.beginPath();
      for (const [a, b] of pairs) {
        if (a.away < 0.2 || b.away < 0.2) continue; // behind the lens
        pen.moveTo(a.x, a.y);
        pen.lineTo(b.x, b.y);
      }
      pen.stroke();
    }

    function drawScene() {
      const pen = canvas.getContext("2d");
      const pixel = window.devicePixelRatio || 1;
      const pose = poseAt(now);
      const project = camera(pose);
      pen.clearRect(0, 0, canvas.width, canvas.height);
      pen.lineCap = "round";
      const [cell, reach] = [0.5, 8]; // metres, cells each way
      const [x0, z0] = [Math.round(pose[0] / cell), Math.round(pose[2] / cell)];
      for (let i = -reach; i <= reach; i++) {
        for (let k = -reach; k < reach; k++) {
          const fade = 1 - Math.hypot(i, k + 0.5) / reach;
          if (fade <= 0) continue;
          const ends = [[x0 + k, z0 + i, x0 + k + 1, z0 + i], [x0 + i, z0 + k, x0 + i, z0 + k + 1]];
          for (const [ax, az, bx, bz] of ends) {
            const line = [[project(ax * cell, 0, az * cell), project(bx * cell, 0, bz * cell)]];
            stroke(pen, line, `rgba(120, 128, 145, ${0.45 * Math.sqrt(fade)})`, pixel);
          }
        }
      }
      const place = (n) => project(frames[n - first][0], 0, frames[n - first][2]);
      const way = [];
      const here = Math.min(Math.floor(now), last());
      for (let n = Math.max(first + 1, here - TRAIL); n <= here; n++) way.push([place(n - 1), place(n)]);
      stroke(pen, way, "rgba(180, 40, 90, 0.7)", 2 * pixel);
      const joint = (j) => project(pose[3 * j], pose[3 * j + 1], pose[3 * j + 2]);
      const shadow = (j) => project(pose[3 * j], 0, pose[3 * j + 2]);
      const bones = [];
      for (let j = 1; j < plan.parents.length; j++) bones.push({ j, ends: [joint(plan.parents[j]), joint(j)], below: [shadow(plan.parents[j]), shadow(j)] });
      stroke(pen, bones.map((bone) => bone.below), "rgba(30, 35, 50, 0.15)", 0.05 * shadow(0).size);
      bones.sort((a, b) => b.ends[0].away + b.ends[1].away - a.ends[0].away - a.ends[1].away); // far ones first
      for (const { j, ends } of bones) stroke(pen, [ends], COLOURS[plan.sides[j]], 0.038 * ends[1].size);
      const head = joint(plan.head);
      pen.fillStyle = COLOURS.middle;
      pen.beginPath();
      pen.arc(head.x, head.y, 0.085 * head.size, 0, 7);
      pen.fill();
    }

    function draw() {
      const pixel = window.devicePixelRatio || 1;
      const [width, height] = [Math.round(canvas.clientWidth * pixel), Math.round(canvas.clientHeight * pixel)];
      if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
      if (width > 0 && height > 0) drawScene();
      const frame = Math.floor(now);
      const hears = told.filter(([from]) => from <= frame).pop() || told[0];
      acting.textContent = hears[1];
      fill.style.width = `${Math.min(left() / plan.fps, 1) * 100}%`;
      const wait = playing && left() === 0 ? ", waiting for the kernel" : "";
      clock.textContent = `${(left() / plan.fps).toFixed(1)} s in the buffer, frame ${frame}${wait}`;
      start.textContent = playing ? "stop" : "start";
      Object.assign(root.dataset, {
        frame, prompt: hears[1], buffer: Math.round(left()), playing: playing ? "yes" : "no",
      });
    }

    // ---- time ------------------------------------------------------------------------------------------------------------
    function tick(time) {
      request = 0;
      if (!playing || !visible || !root.isConnected) return (lastTick = 0);
      if (lastTick) now = Math.min(now + ((time - lastTick) / 1000) * plan.fps, last());
      lastTick = time;
      ask();
      draw();
      request = requestAnimationFrame(tick);
    }

    function go() { // on, unless it is already running, hidden or stopped
      lastTick = 0;
      if (!request && playing && visible) request = requestAnimationFrame(tick);
    }

    function stop() {
      playing = false;
      draw();
    }

    start.onclick = () => {
      playing = !playing;
      asked = false; // an answer that never came must not hold up a new start
      go();
      draw();
    };
    row.onsubmit = (event) => {
      event.preventDefault();
      model.send({ kind: "say", prompt: box.value });
      if (box.value.trim()) playing = true;
      box.select();
      go();
      draw();
    };
    canvas.onpointerdown = (event) => canvas.setPointerCapture(event.pointerId);
    canvas.onpointermove = (event) => {
      if (!canvas.hasPointerCapture(event.pointerId)) return;
      view.yaw -= event.movementX * 0.01;
      view.pitch = Math.min(Math.max(view.pitch + event.movementY * 0.01, -0.1), 1.55);
      draw();
    };
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      view.distance = Math.min(Math.max(view.distance * Math.exp(event.deltaY * 0.001), 1.5), 20);
      draw();
    }, { passive: false });
    for (const name of ["keydown", "keyup", "keypress"]) root.addEventListener(name, (event) => event.stopPropagation()); // or JupyterLab takes the keys

    const seen = new IntersectionObserver((entries) => {
      visible = entries[entries.length - 1].isIntersecting;
      go();
    });
    seen.observe(canvas);
    const resized = new ResizeObserver(draw);
    resized.observe(canvas);
    model.on("msg:custom", onMessage);
    take(model.get("opening"), 0);
    say("press start, then tell it what to do");
    draw();

    return () => {
      playing = false;
      cancelAnimationFrame(request);
      seen.disconnect();
      resized.disconnect();
      model.off("msg:custom", onMessage);
    };
  },
};
