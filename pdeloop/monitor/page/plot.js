// A canvas with two axes: sharp on every screen, in the page's colours, drawn at most once a frame.

const FONT = "12px system-ui, 'Segoe UI', Roboto, 'DejaVu Sans', sans-serif";
const TICK = 70; // pixels between two labels of the horizontal axis, at least
const TICK_Y = 34;

export function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

// A number as a person writes it, with as many digits as a step of this size needs.
export function text(value, step = 0) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size >= 1e6 || (size > 0 && size < 1e-3)) {
    return value.toExponential(1).replace("e+", "e").replace(".0e", "e").replace("-", "−");
  }
  const digits = step ? Math.max(0, -Math.floor(Math.log10(step) + 1e-9)) : null;
  const words = digits === null ? String(Number(value.toPrecision(4))) : value.toFixed(digits);
  return words.replace("-", "−");
}

function steps(low, high, count) {
  const raw = (high - low) / Math.max(1, count);
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].find((m) => m * power >= raw * 0.999) * power;
  const found = [];
  for (let i = Math.ceil(low / step - 1e-6); i * step <= high + 1e-6 * step; i++) found.push(i * step);
  return { found, step };
}

function decades(low, high, count) {
  const span = Math.log10(high / low);
  const subs = span > count / 2 ? [1] : span > count / 4 ? [1, 3] : [1, 2, 5];
  const every = Math.max(1, Math.ceil(span / count));
  const found = [];
  for (let e = Math.floor(Math.log10(low)); 10 ** e <= high; e++) {
    if (e % every) continue;
    for (const m of subs) if (m * 10 ** e >= low && m * 10 ** e <= high) found.push(m * 10 ** e);
  }
  return { found, step: 0 };
}

export class Plot {
  // draw(plot) sets x, y = [low, high] and calls frame(), then paints with at(); describe(x, y) is what
  // the reader's pointer is on.
  constructor(id, draw, describe) {
    this.canvas = document.getElementById(id);
    this.output = document.getElementById(`${id}-text`);
    this.context = this.canvas.getContext("2d");
    this.draw = draw;
    this.describe = describe;
    this.margin = { left: 56, right: 14, top: 8, bottom: 38 };
    this.x = [0, 1];
    this.y = [0, 1];
    this.log = false;
    this.caption = "";
    this.pointer = null;
    new ResizeObserver(() => this.redraw()).observe(this.canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.redraw());
    this.canvas.addEventListener("pointermove", (event) => {
      this.pointer = [event.offsetX, event.offsetY];
      this.redraw();
    });
    this.canvas.addEventListener("pointerleave", () => {
      this.pointer = null;
      this.redraw();
    });
  }

  redraw() {
    this.request ??= requestAnimationFrame(() => {
      this.request = null;
      this.paint();
    });
  }

  paint() {
    const { canvas, context, margin } = this;
    const scale = devicePixelRatio || 1;
    const width = canvas.clientWidth;
    const height = canvas.clientHeight;
    if (width < 60 || height < 60) return;
    const [w, h] = [Math.round(width * scale), Math.round(height * scale)];
    if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
    context.setTransform(scale, 0, 0, scale, 0, 0);
    context.clearRect(0, 0, width, height);
    context.font = FONT;
    this.box = {
      left: margin.left,
      top: margin.top,
      right: width - margin.right,
      bottom: height - margin.bottom,
    };
    this.draw(this);
    this.point();
  }

  px(x) {
    const { left, right } = this.box;
    return left + ((x - this.x[0]) / (this.x[1] - this.x[0])) * (right - left);
  }

  py(y) {
    const { top, bottom } = this.box;
    const [low, high] = this.log ? this.y.map(Math.log) : this.y;
    const value = this.log ? Math.log(Math.max(y, 1e-300)) : y;
    return bottom - ((value - low) / (high - low)) * (bottom - top);
  }

  // Axes, grid and labels.
  frame(xLabel, yLabel, { grid = true, whole = false } = {}) {
    const { context: c, box } = this;
    const across = Math.max(2, (box.right - box.left) / TICK);
    const up = Math.max(2, (box.bottom - box.top) / TICK_Y);
    const xs = steps(...this.x, whole ? Math.min(across, this.x[1] - this.x[0]) : across);
    let ys = this.log ? decades(...this.y, up) : steps(...this.y, up);
    if (this.log && ys.found.length < 2) ys = steps(...this.y, up);
    c.lineWidth = 1;
    c.strokeStyle = colour("grid");
    c.fillStyle = colour("muted");
    c.textBaseline = "top";
    c.textAlign = "center";
    for (const x of xs.found) {
      const p = Math.round(this.px(x)) + 0.5;
      if (grid) this.stroke([p, box.top], [p, box.bottom]);
      c.fillText(text(x, xs.step), p, box.bottom + 6);
    }
    c.textAlign = "right";
    c.textBaseline = "middle";
    for (const y of ys.found) {
      const p = Math.round(this.py(y)) + 0.5;
      if (grid) this.stroke([box.left, p], [box.right, p]);
      c.fillText(text(y, ys.step), box.left - 7, p);
    }
    c.strokeStyle = colour("line");
    c.strokeRect(box.left + 0.5, box.top + 0.5, box.right - box.left - 1, box.bottom - box.top - 1);
    c.textAlign = "center";
    c.textBaseline = "bottom";
    c.fillText(xLabel, (box.left + box.right) / 2, box.bottom + this.margin.bottom);
    c.save();
    c.translate(12, (box.top + box.bottom) / 2);
    c.rotate(-Math.PI / 2);
    c.textBaseline = "middle";
    c.fillText(yLabel, 0, 0);
    c.restore();
  }

  stroke(...points) {
    const c = this.context;
    c.beginPath();
    for (const [x, y] of points) c.lineTo(x, y);
    c.stroke();
  }

  clip(paint) {
    const { context: c, box } = this;
    c.save();
    c.beginPath();
    c.rect(box.left, box.top, box.right - box.left, box.bottom - box.top);
    c.clip();
    paint();
    c.restore();
  }

  // A line through (xs[i], ys[i]); a value that is not finite interrupts it. `held`: as steps.
  line(xs, ys, style, { width = 1.6, dash = [], held = false } = {}) {
    const c = this.context;
    c.save();
    c.strokeStyle = style;
    c.lineWidth = width;
    c.lineJoin = "round";
    c.setLineDash(dash);
    c.beginPath();
    let before = null;
    for (let i = 0; i < xs.length; i++) {
      if (ys[i] === null || !Number.isFinite(ys[i])) {
        before = null;
        continue;
      }
      const [x, y] = [this.px(xs[i]), this.py(ys[i])];
      if (before === null) c.moveTo(x, y);
      else if (held) c.lineTo(x, before);
      c.lineTo(x, y);
      before = y;
    }
    c.stroke();
    c.restore();
  }

  // Names of the lines: [name, colour, dash] each, in a row at the top right of the box.
  legend(entries) {
    const { context: c, box } = this;
    c.textBaseline = "middle";
    c.textAlign = "left";
    const widths = entries.map(([name]) => c.measureText(name).width + 38);
    let x = box.right - widths.reduce((a, b) => a + b, 0);
    const y = box.top + 13;
    c.save();
    c.globalAlpha = 0.8;
    c.fillStyle = colour("panel");
    c.fillRect(x - 6, y - 9, box.right - x + 4, 18);
    c.restore();
    entries.forEach(([name, style, dash], i) => {
      c.save();
      c.strokeStyle = style;
      c.lineWidth = 2;
      c.setLineDash(dash ?? []);
      this.stroke([x, y], [x + 18, y]);
      c.restore();
      c.fillStyle = colour("text");
      c.fillText(name, x + 23, y);
      x += widths[i];
    });
  }

  message(words) {
    const { context: c, box } = this;
    c.fillStyle = colour("muted");
    c.textAlign = "center";
    c.textBaseline = "middle";
    c.fillText(words, (box.left + box.right) / 2, (box.top + box.bottom) / 2);
  }

  point() {
    const { box, pointer } = this;
    let words = this.caption;
    const inside =
      pointer &&
      pointer[0] >= box.left &&
      pointer[0] <= box.right &&
      pointer[1] >= box.top &&
      pointer[1] <= box.bottom;
    if (inside) {
      const share = (pointer[0] - box.left) / (box.right - box.left);
      const up = (box.bottom - pointer[1]) / (box.bottom - box.top);
      const x = this.x[0] + share * (this.x[1] - this.x[0]);
      const y = this.y[0] + up * (this.y[1] - this.y[0]);
      const found = this.describe(x, y);
      if (found) {
        words = found;
        const c = this.context;
        c.strokeStyle = colour("muted");
        c.lineWidth = 1;
        this.stroke([pointer[0], box.top], [pointer[0], box.bottom]);
      }
    }
    if (this.output.textContent !== words) this.output.textContent = words;
  }

  say(words) {
    if (this.canvas.getAttribute("aria-label") !== words) this.canvas.setAttribute("aria-label", words);
  }
}
