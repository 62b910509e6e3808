// Draws the figures of a page that have something to zoom into, in place of their static pictures.
"use strict";
(() => {
  const read = id => JSON.parse(document.getElementById(id).textContent);
  const stored = read("numbers"), described = read("charts");
  const known = new Map(), groups = new Map(), HEIGHT_OF_LETTER = 12;
  let live = [], busy = false;

  function numbers(k) {
    if (known.has(k)) return known.get(k);
    const one = stored[k];
    let values;
    if (typeof one === "string") {
      const bytes = Uint8Array.from(atob(one.slice(1)), c => c.charCodeAt(0)).buffer;
      const raw = one[0] === "8" ? new Float64Array(bytes) : new Float32Array(bytes);
      values = Array.from(raw, v => Number.isFinite(v) ? v : null);
    } else {
      const [first, last, n] = one, step = (last - first) / (n - 1);
      values = Array.from({ length: n }, (_, k) => first + k * step);
    }
    known.set(k, values);
    return values;
  }

  const style = getComputedStyle(document.documentElement);
  const css = name => name[0] === "#" ? name : style.getPropertyValue("--" + name).trim();
  const font = `${HEIGHT_OF_LETTER}px system-ui, sans-serif`;
  const short = v => {
    if (v == null) return "";
    const rounded = +v.toPrecision(7), size = Math.abs(rounded);
    return size && (size < 1e-3 || size >= 1e6) ? rounded.toExponential() : String(rounded);
  };

  // Lines over one x are a table; tables of several x are joined, which leaves holes that are no gaps.
  function table(lines) {
    const tables = new Map();
    lines.forEach(line => {
      if (!tables.has(line.x)) tables.set(line.x, []);
      tables.get(line.x).push(line);
    });
    const parts = [...tables].map(([x, of]) => [numbers(x), ...of.map(line => numbers(line.y))]);
    return { data: parts.length > 1 ? uPlot.join(parts) : parts[0], lines: [...tables.values()].flat() };
  }

  // ---- what stands beside the lines: bands beneath them, levels and words above

  const pixel = (u, v, axis) => v == null ? NaN : u.valToPos(v, axis, true);

  function clipped(u, draw) {
    const { left, top, width, height } = u.bbox;
    u.ctx.save();
    u.ctx.beginPath();
    u.ctx.rect(left, top, width, height);
    u.ctx.clip();
    draw(u.ctx, { left, top, width, height });
    u.ctx.restore();
  }

  const beneath = marks => u => clipped(u, (ctx, box) => marks.forEach(mark => {
    ctx.fillStyle = css(mark.color);
    if (mark.kind === "fill_between") {
      const [x, low, high] = [mark.x, mark.low, mark.high].map(numbers);
      ctx.globalAlpha = mark.alpha;
      ctx.beginPath();
      x.forEach((v, k) => ctx.lineTo(pixel(u, v, "x"), pixel(u, high[k], "y")));
      for (let k = x.length - 1; k >= 0; k--) ctx.lineTo(pixel(u, x[k], "x"), pixel(u, low[k], "y"));
      ctx.fill();
      ctx.globalAlpha = 1;
    } else if (mark.kind.endsWith("span")) {
      const upright = mark.kind === "axvspan", [a, b] = mark.at.map(v => pixel(u, v, upright ? "x" : "y"));
      if (upright) ctx.fillRect(a, box.top, b - a, box.height);
      else ctx.fillRect(box.left, a, box.width, b - a);
    }
  }));

  const above = marks => u => clipped(u, (ctx, box) => marks.forEach(mark => {
    const ratio = uPlot.pxRatio;
    if (mark.kind === "write") {
      ctx.fillStyle = css(mark.color);
      ctx.font = `${(mark.size + 3) * ratio}px system-ui, sans-serif`;
      ctx.textAlign = mark.middle ? "center" : "left";
      const [right, up] = mark.shift;
      ctx.fillText(mark.words, pixel(u, mark.at[0], "x") + right * ratio, pixel(u, mark.at[1], "y") - up * ratio);
    } else if (mark.kind.endsWith("line")) {
      const upright = mark.kind === "axvline", at = pixel(u, mark.at[0], upright ? "x" : "y");
      ctx.strokeStyle = css(mark.color);
      ctx.lineWidth = mark.width * ratio;
      ctx.setLineDash(mark.dash.map(v => v * ratio));
      ctx.beginPath();
      ctx.moveTo(upright ? at : box.left, upright ? box.top : at);
      ctx.lineTo(upright ? at : box.left + box.width, upright ? box.top + box.height : at);
      ctx.stroke();
    }
  }));

  // ---- zoom

  const group = u => u.linked ? groups.get(u.linked) : [u];

  function whole(u) {
    busy = true;
    group(u).forEach(one => one.batch(() => {
      const [left, right, low, high] = one.whole;
      one.setScale("x", { min: left, max: right });
      one.setScale("y", { min: low, max: high });
    }));
    busy = false;
    group(u).forEach(said);
  }

  // A window of `share` of the width of this one, moved by `way` of its own width.
  function move(u, share, way) {
    const { min, max } = u.scales.x, width = share * (max - min), [left, right] = u.whole;
    const start = Math.min(Math.max((min + max - width) / 2 + way * width, left), right - width);
    u.setScale("x", { min: start, max: start + width });
  }

  function said(u) {
    const now = [u.scales.x.min, u.scales.x.max, u.scales.y.min, u.scales.y.max];
    const zoomed = now.some((end, k) => end !== u.whole[k]);
    u.tools.querySelectorAll(".zoomed").forEach(button => { button.hidden = !zoomed; });
  }

  // For those without a mouse, and to walk from cycle to cycle.
  function tools(u) {
    const bar = document.createElement("span"), buttons = [["whole", "show all of it", () => whole(u), "zoomed"]];
    bar.className = "tools";
    if (!u.log) buttons.unshift(
      ["+", "closer", () => move(u, 0.5, 0), ""], ["◀", "earlier", () => move(u, 1, -1), "zoomed"], ["▶", "later", () => move(u, 1, 1), "zoomed"],
    );
    for (const [words, title, act, className] of buttons) {
      const button = document.createElement("button");
      Object.assign(button, { type: "button", textContent: words, title, onclick: act, className });
      button.setAttribute("aria-label", title);
      bar.append(button);
    }
    return bar;
  }

  // ---- a chart

  function axis(label, side, log) {
    return {
      label, side, font, labelFont: font, labelSize: 20, size: side === 3 ? 62 : 32, gap: 4,
      stroke: () => css("ink"), grid: { stroke: () => css("grid"), width: 1 }, ticks: { stroke: () => css("grid"), width: 1, size: 5 },
      values: (u, places) => places.map(short), space: side === 3 ? 26 : log ? 50 : 80,
    };
  }

  function make(one, place) {
    const picture = place.querySelector("svg");
    const height = Math.round(Math.max(150, +place.dataset.height));
    const { data, lines } = table(one.lines);
    const levels = one.marks.filter(mark => mark.kind === "axhline").map(mark => mark.at[0]);
    const fitted = (u, low, high) => {
      if (low == null) return one.limits.slice(2);
      const ends = [Math.min(low, ...levels), Math.max(high, ...levels)];
      if (one.log[1]) return [ends[0] / 1.3, ends[1] * 1.3];
      const spare = 0.06 * (ends[1] - ends[0]) || 0.05 * Math.abs(ends[0]) || 1;
      return [ends[0] - spare, ends[1] + spare];
    };
    const series = lines.map(line => ({
      label: line.label, stroke: () => css(line.color), width: line.joined ? line.width : 0, dash: line.dash.length ? line.dash : undefined,
      ...(line.joined ? {} : { paths: () => null }),
      points: line.size ? { show: true, size: line.size, width: 0, fill: () => css(line.color) } : { size: 4, width: 0, fill: () => css(line.color) },
    }));
    const readout = place.parentNode.querySelector("output");
    const name = words => words.replace(/ \[.*/, "");
    const unit = words => (words.match(/\[(.*?)\]/) || ["", ""])[1].replace(/^1$/, "");
    const read = u => {
      const k = u.cursor.idx;
      readout.textContent = k == null ? "" : [
        `${name(one.x)} ${short(data[0][k])} ${unit(one.x)}`,
        ...lines.map((line, i) => [line, data[i + 1][k]]).filter(([, v]) => v != null)
          .map(([line, v]) => `${line.label || name(one.y)} ${short(v)} ${unit(one.y)}`),
      ].join("  ·  ");
    };
    const u = new uPlot({
      width: place.clientWidth, height, legend: { show: false },
      scales: { x: { time: false, distr: one.log[0] ? 3 : 1, range: (u, low, high) => [low, high] }, y: { distr: one.log[1] ? 3 : 1, range: fitted } },
      axes: [axis(one.x, 2, one.log[0]), axis(one.y, 3, one.log[1])],
      series: [{}, ...series],
      cursor: {
        drag: { x: true, y: false, dist: 5 }, points: { size: 6 },
        bind: { dblclick: self => () => { whole(self); return null; } },
        ...(one.linked ? { sync: { key: one.linked, setSeries: false, scales: ["x", null], filters: { pub: type => type === "mousemove" || type === "mouseleave" } } } : {}),
      },
      hooks: {
        drawAxes: [beneath(one.marks)], draw: [above(one.marks)], setCursor: [read],
        setScale: [(self, key) => {
          if (!self.tools) return;
          if (key === "x" && !busy && self.linked) {
            busy = true;
            const { min, max } = self.scales.x;
            group(self).filter(one => one !== self).forEach(one => one.setScale("x", { min, max }));
            busy = false;
          }
          group(self).forEach(said);
        }],
      },
    }, data, place);
    Object.assign(u, { linked: one.linked, whole: one.limits, log: one.log[0] });
    if (u.linked) groups.set(u.linked, [...(groups.get(u.linked) || []), u]);
    u.tools = tools(u);
    place.parentNode.querySelector(".head").append(u.tools);
    whole(u);
    place.classList.add("live");
    live.push({ u, place, height });
  }

  function draw() {
    live.forEach(({ u }) => { u.tools.remove(); u.destroy(); });
    live = [];
    groups.clear();
    document.querySelectorAll("[data-chart]").forEach(place => make(described[+place.dataset.chart], place));
    window.charts = live.map(({ u }) => u);
  }

  draw();
  document.querySelectorAll(".hint").forEach(hint => { hint.hidden = !live.length; });
  new ResizeObserver(() => live.forEach(({ u, place, height }) => {
    if (u.width !== place.clientWidth && place.clientWidth) u.setSize({ width: place.clientWidth, height });
  })).observe(document.body);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
})();
