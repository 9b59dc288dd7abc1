// Actions, profile and training curve.

import { css } from "./cividis.js";
import { Plot, colour, text } from "./plot.js";

// Okabe and Ito's colours, readable with any colour vision; more lines than these go along cividis.
const LINES = ["#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00"];
const DOTTED = [2, 3];
const DASHED = [7, 4];

function extent(...lists) {
  let [low, high] = [Infinity, -Infinity];
  for (const list of lists) {
    for (const value of list) {
      if (value < low) low = value;
      if (value > high) high = value;
    }
  }
  return low <= high ? [low, high] : [0, 1];
}

export function actionsPlot(episode, facts) {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  // Of cividis the part that stands out from the background.
  const along = (share) => css(dark.matches ? 0.35 + 0.65 * share : 0.8 * share);
  const style = (j, count) => (count <= LINES.length ? LINES[j] : along((j + 0.5) / count));

  function draw(plot) {
    const { header } = episode;
    const count = header ? header.actions : 0;
    plot.x = header ? episode.span(facts.horizon) : [0, 1];
    const [low, high] = extent(episode.actions);
    const largest = Math.max(Math.abs(low), Math.abs(high)) || 1;
    plot.y = count ? [-1.1 * largest, 1.35 * largest] : [-1, 1];
    plot.frame(episode.timeLabel, "action");
    if (!count) {
      plot.message("no action has come yet");
      plot.caption = "";
      plot.say("Actions: nothing yet");
      return;
    }
    const columns = episode.actions.length / count;
    const times = Array.from({ length: columns + 1 }, (_, i) => episode.time(episode.step(i)));
    plot.clip(() => {
      for (let j = 0; j < count; j++) {
        const own = times.map((_, i) => episode.actions[Math.min(i, columns - 1) * count + j]);
        plot.line(times, own, style(j, count), { width: 1.3, held: true });
      }
    });
    plot.legend(
      count <= LINES.length
        ? Array.from({ length: count }, (_, j) => [`${j + 1}`, style(j, count)])
        : [["1", style(0, count)], [`${count}`, style(count - 1, count)]],
    );
    plot.caption = facts.n_a > count ? `the first ${count} of ${facts.n_a} actuators` : "";
    plot.say(`Actions of ${count} actuators, at most ${text(largest)} in magnitude`);
  }

  function describe(t) {
    const { header } = episode;
    if (!header?.actions) return "";
    const column = Math.floor((t / (header.sample_time || 1) - header.begin) / header.stride);
    const own = episode.actions.subarray(column * header.actions, (column + 1) * header.actions);
    if (column < 0 || !own.length) return "";
    const shown = Array.from(own.subarray(0, 8), (a) => text(a)).join(", ");
    return `t ${text(t)}: ${shown}${own.length > 8 ? ", …" : ""}`;
  }

  const plot = new Plot("actions", draw, describe);
  plot.margin.right = 74; // so that its time axis is that of the field above
  return plot;
}

export function profilePlot(episode, facts) {
  const grid = (count) => Array.from({ length: count }, (_, i) => (i / count) * plot.x[1]);

  function draw() {
    const { header, latest, target } = episode;
    plot.x = [0, facts.length || Math.max(1, latest.length)];
    const label = facts.length ? "x (m)" : "grid point";
    if (!header) {
      plot.y = [-1, 1];
      plot.frame(label, facts.name);
      plot.message("no state has come yet");
      plot.say("Profile: nothing yet");
      return;
    }
    const initial = header.begin === 0 ? episode.fields.subarray(0, header.rows) : [];
    const [low, high] = extent(latest, target, initial, header.range);
    plot.y = [low - 0.08 * (high - low), high + 0.28 * (high - low)]; // with room for the legend
    plot.frame(label, facts.name);
    plot.clip(() => {
      if (initial.length) plot.line(grid(initial.length), initial, colour("none"), { dash: DOTTED, width: 1.3 });
      if (target.length) plot.line(grid(target.length), target, colour("text"), { dash: DASHED, width: 1.3 });
      plot.line(grid(latest.length), latest, colour("adapted"), { width: 2 });
    });
    const entries = [];
    if (initial.length) entries.push(["initial", colour("none"), DOTTED]);
    if (target.length) entries.push(["target", colour("text"), DASHED]);
    plot.legend([...entries, [`${facts.name}(x, t)`, colour("adapted")]]);
    let error = 0;
    for (let i = 0; i < target.length; i++) error += (latest[i] - target[i]) ** 2;
    const distance = target.length ? Math.sqrt(error / target.length) : null;
    const when = header.sample_time ? `t = ${text(episode.time(header.last))} s` : `step ${header.last}`;
    plot.caption = distance === null ? when : `${when}, rms distance to the target ${text(distance)}`;
    plot.say(`Profile at ${plot.caption}`);
  }

  function describe(x) {
    const { latest, target } = episode;
    const at = (values) => values[Math.min(values.length - 1, Math.floor((x / plot.x[1]) * values.length))];
    if (!latest.length) return "";
    const aim = target.length ? `, target ${text(at(target))}` : "";
    return `x ${text(x)}: ${facts.name} = ${text(at(latest))}${aim}`;
  }

  const plot = new Plot("profile", draw, describe);
  return plot;
}

const NAMES = { none: "no control", lqt: "LQT", adapted: "adapted" };
const REFERENCES = { none: DOTTED, lqt: DASHED };

export function curvePlot(curve) {
  function range(points, references) {
    const costs = points.flatMap(([, ...costs]) => costs.slice(0, 3)).filter((c) => c !== null);
    let [low, high] = extent(costs);
    // What it is compared with is shown unless it would squeeze the curve flat.
    for (const value of Object.values(references)) {
      if (!costs.length || (value < 1.6 * high && value > low / 1.6)) {
        [low, high] = [Math.min(low, value), Math.max(high, value)];
        if (!costs.length) [low, high] = extent(Object.values(references));
      }
    }
    return [low, high];
  }

  function draw(plot) {
    const { points, references, axis, total, band } = curve.told;
    const last = points.length ? points[points.length - 1][0] : 0;
    const first = points.length ? Math.min(points[0][0], 1) : 1;
    let end = 10; // grows in jumps, so that the curve stays where it is for a while
    while (end < last) end *= 2;
    plot.x = [first, total ? Math.max(Math.min(end, total), last, first + 1) : end];
    const [low, high] = range(points, references);
    plot.log = low > 0 && high / low > 6;
    const room = 0.12 * (high - low) || 0.5 * Math.abs(high) || 1;
    plot.y = plot.log ? [low / 1.25, high * 1.6] : [low - room, high + 2 * room];
    plot.frame(axis, "mean stage cost", { whole: true });
    plot.clip(() => {
      for (const [name, dash] of Object.entries(REFERENCES)) {
        const value = references[name];
        if (value !== undefined) plot.line(plot.x, [value, value], colour(name), { dash, width: 1.5 });
      }
      area(plot, points);
      plot.line(points.map((p) => p[0]), points.map((p) => p[1]), colour("adapted"), { width: 2 });
      const known = points.filter((p) => p[1] !== null);
      if (known.length) dot(plot, known[known.length - 1]);
    });
    if (!points.length) plot.message("no iteration yet");
    const [bottom, top] = plot.y;
    const entries = Object.keys(REFERENCES)
      .filter((name) => references[name] !== undefined)
      .map((name) => {
        const outside = references[name] > top ? " ↑" : references[name] < bottom ? " ↓" : "";
        const value = outside ? ` ${text(references[name])}${outside}` : "";
        return [`${NAMES[name]}${value}`, colour(name), REFERENCES[name]];
      });
    const over = points.length ? ` (band: ${band})` : "";
    plot.legend([...entries, [`adapting${over}`, colour("adapted")]]);
    plot.caption = summary(points, references);
    plot.say(`Training: ${plot.caption || "no iteration yet"}`);
  }

  function area(plot, points) {
    const c = plot.context;
    const known = points.filter((p) => p[2] !== null);
    c.fillStyle = colour("band");
    c.beginPath();
    for (const [x, , , high] of known) c.lineTo(plot.px(x), plot.py(high));
    for (const [x, , low] of known.slice().reverse()) c.lineTo(plot.px(x), plot.py(low));
    c.fill();
  }

  function dot(plot, [x, mean]) {
    const c = plot.context;
    c.fillStyle = colour("adapted");
    c.beginPath();
    c.arc(plot.px(x), plot.py(mean), 3.2, 0, 2 * Math.PI);
    c.fill();
  }

  function summary(points, { lqt, adapted }) {
    if (adapted !== undefined && lqt) {
      const share = 100 * (1 - adapted / lqt);
      const side = share >= 0 ? "below" : "above";
      return `evaluated: ${text(adapted)}, ${Math.abs(share).toFixed(1)} % ${side} LQT`;
    }
    const lost = points.reduce((sum, p) => sum + p[4], 0);
    return lost ? `${lost} rollouts diverged` : "";
  }

  function describe(x) {
    const { points, axis } = curve.told;
    if (!points.length) return "";
    const near = points.reduce((a, b) => (Math.abs(b[0] - x) < Math.abs(a[0] - x) ? b : a));
    if (near[1] === null) return `${axis} ${near[0]}: diverged`;
    return `${axis} ${near[0]}: ${text(near[1])} (${text(near[2])} to ${text(near[3])})`;
  }

  return new Plot("curve", draw, describe);
}
