// The noise painter: bars of noise levels to drag over, what the model said of each latent, the motions in players.
// It stands behind player.js, whose minicmdmPlayer it calls; the numbers come from viz/painter.py. No library, no network.
//
// For tests: .painter (data-levels, data-serial counts answers, data-busy "yes" or "no"), .painter-level[data-latent]
// (role slider, data-level), .painter-preset[data-preset], .painter-value[data-series][data-latent], .painter-problem,
// .painter-player.

export default {
  render({ model, el }) {
    const plan = model.get("plan");
    const TALL = { levels: 112, loss: 44, off: 44 }; // pixels
    let levels = [...model.get("levels")];
    let sent = levels.join(); // what Python was last asked for
    let answered = sent;
    let player = null;
    let brush = null; // the last place of a drag: latent and level

    function make(tag, parent, style, name, data) {
      const element = document.createElement(tag);
      Object.assign(element.style, style || {});
      if (name) element.className = name;
      Object.assign(element.dataset, data || {});
      parent.appendChild(element);
      return element;
    }

    // White on a dark theme too.
    const root = make("div", el, {
      background: "#fff", color: "#1f2430", padding: "8px 10px", font: "13px system-ui, sans-serif",
      boxSizing: "border-box", maxWidth: "1100px", colorScheme: "light",
    }, "painter", { serial: 0 });
    const caption = make("div", root, { fontSize: "15px", paddingBottom: "2px" });
    caption.textContent = `“${plan.caption}”`;
    const help = make("div", root, { color: "#5b6270", paddingBottom: "6px" });
    help.textContent = "Drag over the upper bars to paint a noise level for each latent (or Tab to one, then arrow keys).";
    const buttons = make("div", root, { display: "flex", gap: "6px", flexWrap: "wrap", paddingBottom: "6px" });
    for (const name of Object.keys(plan.presets)) {
      const button = make("button", buttons, { padding: "3px 9px" }, "painter-preset", { preset: name });
      button.type = "button";
      button.textContent = name;
      button.onclick = () => paint(plan.presets[name]);
    }

    // ---- one row of bars for each series, column under column ------------------------------------------------------
    const bars = {};
    for (const { name, label, colour } of plan.series) {
      const row = make("div", root, { display: "flex", alignItems: "stretch", marginBottom: "4px" });
      const title = make("div", row, { width: "78px", flex: "none", alignSelf: "center", color: "#5b6270" });
      title.textContent = label;
      const area = make("div", row, {
        display: "flex", flex: "1", gap: "2px", height: `${TALL[name]}px`, touchAction: "none",
        cursor: name === "levels" ? "ns-resize" : "default", userSelect: "none",
      });
      const paints = name === "levels";
      bars[name] = levels.map((_, latent) => {
        const column = make("div", area, {
          flex: "1", minWidth: "0", position: "relative", background: "#eef0f3", borderRadius: "3px", overflow: "hidden",
        }, paints ? "painter-level" : "painter-value", { latent, series: name });
        const fill = make("div", column, { position: "absolute", inset: "auto 0 0 0", background: colour });
        const text = make("div", column, {
          position: "absolute", inset: paints ? "auto 0 1px 0" : "1px 0 auto 0", textAlign: "center", fontSize: "10px", pointerEvents: "none",
          textShadow: "0 0 3px #fff, 0 0 3px #fff, 0 0 2px #fff",
        });
        if (paints) {
          column.tabIndex = 0;
          for (const [key, value] of [["role", "slider"], ["aria-orientation", "vertical"], ["aria-valuemin", 0],
            ["aria-valuemax", plan.top], ["aria-label", `noise level of latent ${latent}`]]) column.setAttribute(key, value);
        }
        return { column, fill, text };
      });
      if (!paints) continue;
      area.classList.add("painter-area");
      area.onpointerdown = (event) => {
        area.setPointerCapture(event.pointerId);
        brush = null;
        stroke(event);
      };
      area.onpointermove = (event) => { if (area.hasPointerCapture(event.pointerId)) stroke(event); };
      function stroke(event) { // a fast drag skips columns: fill what lies between
        const box = area.getBoundingClientRect();
        const inside = (value, top) => Math.min(Math.max(value, 0), top);
        const latent = inside(Math.floor((levels.length * (event.clientX - box.left)) / box.width), levels.length - 1);
        const level = inside(Math.round(plan.top * (1 - (event.clientY - box.top) / box.height)), plan.top);
        const [from, start] = brush || [latent, level];
        const next = [...levels];
        const steps = Math.max(Math.abs(latent - from), 1);
        for (let i = brush && latent !== from ? 1 : steps; i <= steps; i++) {
          next[Math.round(from + ((latent - from) * i) / steps)] = Math.round(start + ((level - start) * i) / steps);
        }
        brush = [latent, level];
        bars.levels[latent].column.focus({ preventScroll: true });
        paint(next);
      }
    }
    const problem = make("div", root, { color: "#b01428" }, "painter-problem");
    problem.setAttribute("role", "status");
    const stage = make("div", root, { paddingTop: "4px" }, "painter-player");

    function height(series, latent, value, shown) {
      const { column, fill, text } = bars[series.name][latent];
      fill.style.height = `${Math.min((100 * value) / series.top, 100)}%`;
      text.textContent = shown;
      column.title = `latent ${latent}: ${series.label} ${shown}`;
      return column;
    }

    function paint(next) { // show it here and now, and ask Python when it is free
      levels = [...next];
      levels.forEach((level, latent) => {
        const column = height(plan.series[0], latent, level, level);
        column.dataset.level = level;
        column.setAttribute("aria-valuenow", level);
      });
      root.dataset.levels = levels.join();
      ask();
    }

    function ask() { // one question at a time; what is painted meanwhile is asked when the answer has come
      if (levels.join() !== sent && sent === answered) {
        sent = levels.join();
        model.set("levels", [...levels]);
        model.save_changes();
      }
      root.dataset.busy = levels.join() === answered ? "no" : "yes";
    }

    function receive() {
      const shown = model.get("shown");
      answered = shown.levels.join();
      if (model.get("levels").join() !== sent) { // somebody else set the levels: from Python, or in a second view
        sent = answered;
        paint(shown.levels);
      }
      problem.textContent = shown.problem;
      for (const series of plan.series.slice(1)) {
        shown.values[series.name].forEach((value, latent) => {
          const column = height(series, latent, value, value.toFixed(series.top < 10 ? 1 : 0));
          column.dataset.value = value;
        });
      }
      const frame = Number(stage.dataset.frame || 0);
      const playing = player ? stage.querySelector("button").textContent === "pause"
        : !matchMedia("(prefers-reduced-motion: reduce)").matches;
      if (player) player.destroy();
      player = minicmdmPlayer(stage, shown.motions);
      player.seek(frame);
      if (playing) player.play();
      root.dataset.serial = Number(root.dataset.serial) + 1;
      ask();
    }

    function onKey(event) {
      event.stopPropagation(); // or JupyterLab takes the key for itself
      const column = event.target.closest(".painter-level");
      if (!column || event.ctrlKey || event.metaKey || event.altKey) return;
      const latent = Number(column.dataset.latent);
      const moves = { ArrowLeft: -1, ArrowRight: 1 };
      const levelOf = {
        ArrowUp: levels[latent] + 1, ArrowDown: levels[latent] - 1, PageUp: levels[latent] + 5,
        PageDown: levels[latent] - 5, Home: 0, End: plan.top,
      };
      if (event.key in moves) {
        bars.levels[Math.min(Math.max(latent + moves[event.key], 0), levels.length - 1)].column.focus();
      } else if (event.key in levelOf) {
        const next = [...levels];
        next[latent] = Math.min(Math.max(levelOf[event.key], 0), plan.top);
        paint(next);
      } else return;
      event.preventDefault();
    }
    root.addEventListener("keydown", onKey);
    paint(levels);
    receive();
    model.on("change:shown", receive);
    return () => {
      model.off("change:shown", receive);
      root.removeEventListener("keydown", onKey);
      player.destroy();
    };
  },
};
