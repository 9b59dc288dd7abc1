// Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
// Actions, profile and learning curve.

import { Chart } from "./chart.js";
import { RIGHT, bar, paint } from "./field.js";
import { colour, text } from "./format.js";

// Okabe and Ito's colours, readable with any colour vision; more actions than these are a picture.
const LINES = ["#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00"];
const DOTTED = [2, 3];
const DASHED = [7, 4];
const MOST_SEEDS = 24; // whose lines can be told apart at all

export function extent(...lists) {
  let [low, high] = [Infinity, -Infinity];
  for (const list of lists) {
    for (const value of list) {
      if (value === null) continue;
      if (value < low) low = value;
      if (value > high) high = value;
    }
  }
  return low <= high ? [low, high] : [0, 1];
}

// The actions of an episode, as they were applied, with the bounds of their actuators.
export function actionsChart(model) {
  const chart = new Chart("actions", { right: RIGHT, hooks: { draw: [(plot) => picture(plot)] } });

  // Many actions: a row of colours for each.
  function picture(plot) {
    const { episode } = model;
    const count = episode.header?.actions ?? 0;
    if (count <= LINES.length) return;
    const columns = episode.actions.length / count;
    const colours = range();
    const ratio = devicePixelRatio;
    const area = Object.fromEntries(
      Object.entries({ x: "left", y: "top", w: "width", h: "height" }).map(([k, of]) => [k, plot.bbox[of] / ratio]),
    );
    const [from, to] = [0, columns].map((i) => plot.valToPos(episode.time(episode.step(i)), "x") + area.x);
    const c = plot.ctx;
    c.save();
    c.scale(ratio, ratio);
    c.imageSmoothingEnabled = false;
    const drawn = paint(count, columns, colours, (j, i) => episode.actions[i * count + j]);
    c.save();
    c.beginPath();
    c.rect(area.x, area.y, area.w, area.h);
    c.clip();
    c.drawImage(drawn, from, area.y, to - from, area.h);
    c.restore();
    bar(c, area.x + area.w + 8, area, colours);
    c.restore();
  }

  // [low, high] of what is shown: the actions, 0, and bounds that are not far away.
  function range() {
    let [low, high] = extent(model.episode.actions.filter((a) => !Number.isNaN(a)), [0]);
    const reach = 2 * Math.max(high, -low);
    for (const bound of limits()) {
      if (Math.abs(bound) <= reach) [low, high] = [Math.min(low, bound), Math.max(high, bound)];
    }
    return high > low ? [low, high] : [low - 1, high + 1];
  }

  // The bounds that there are.
  function limits() {
    const { low = [], high = [] } = model.facts.bounds ?? {};
    return [...new Set([...low, ...high])].filter((bound) => bound !== null);
  }

  // Share of the actions that are at a bound, in words; empty without bounds.
  function saturation(count) {
    if (!count || !limits().length) return "";
    const at = (bounds, j, sign) => {
      const bound = bounds[j] ?? null;
      return bound === null ? Infinity : sign * Math.fround(bound);
    };
    const { low, high } = model.facts.bounds;
    let [all, full] = [0, 0];
    model.episode.actions.forEach((a, i) => {
      if (Number.isNaN(a)) return;
      all += 1;
      const j = i % count;
      if (a >= at(high, j, 1) || -a >= at(low, j, -1)) full += 1;
    });
    return `${text(Number(((100 * full) / Math.max(1, all)).toPrecision(3)))} % at a bound`;
  }

  chart.update = () => {
    const { facts, episode } = model;
    const { header } = episode;
    const count = header?.actions ?? 0;
    const columns = count ? episode.actions.length / count : 0;
    const times = Array.from({ length: count ? columns + 1 : 0 }, (_, i) => episode.time(episode.step(i)));
    const held = (j) =>
      times.map((_, i) => {
        const a = episode.actions[Math.min(i, columns - 1) * count + j];
        return Number.isNaN(a) ? null : a;
      });
    const few = count <= LINES.length;
    const [low, high] = range();
    const room = 0.06 * (high - low);
    const lines = few
      ? Array.from({ length: count }, (_, j) => [held(j), { label: `a${j + 1}`, stroke: LINES[j], width: 1.3, steps: true }])
      : [[times.map(() => 1), { class: "unnamed", label: "", stroke: "transparent", width: 0 }]];
    const shown = few && count ? limits().filter((bound) => bound >= low && bound <= high) : [];
    shown.forEach((bound, i) => {
      const named = i ? { class: "unnamed" } : {};
      const style = { label: "bounds", stroke: colour("muted"), dash: DOTTED, width: 1.3, ...named };
      lines.push([times.map(() => bound), style]);
    });
    const first = facts.n_a > count && count ? `the first ${count} of ${facts.n_a} actuators` : "";
    chart.show({
      data: count ? [times, ...lines.map(([values]) => values)] : [[]],
      series: count ? lines.map(([, style]) => style) : [],
      x: { label: header ? episode.timeLabel : "t (s)", range: header ? episode.span(facts.horizon) : [0, 1] },
      y: few
        ? { label: "action", range: [low - room, high + room] }
        : { label: "actuator j", range: [0.5, count + 0.5], whole: true },
      caption: [saturation(count), first].filter(Boolean).join(", "),
      words: count ? `Actions of ${count} actuators, from ${text(low)} to ${text(high)}` : "Actions: nothing yet",
    });
  };
  return chart;
}

// The newest state over its one axis, beside the target; of a field on two axes how far it is from it.
export function profileChart(model) {
  const chart = new Chart("profile");

  function curves() {
    const { facts, episode } = model;
    const { header, panels } = episode;
    const axis = facts.axes[0];
    const count = episode.rows;
    const length = axis.length || Math.max(1, count);
    const [first, last] = axis.length ? (axis.ends ?? [0, (length * (count - 1)) / count]) : [0, count - 1];
    const lines = [];
    panels.forEach((component, p) => {
      const name = facts.names[component] ?? "u";
      const [of, many] = panels.length > 1 ? [` of ${name}`, true] : ["", false];
      const target = episode.ofTarget(p);
      if (header?.begin === 0 && !many) {
        lines.push(["initial", episode.drawn(episode.initial, p), { stroke: colour("muted"), dash: DOTTED, width: 1.3 }]);
      }
      if (target.length) {
        const stroke = many ? LINES[p % LINES.length] : colour("text");
        lines.push([`target${of}`, target, { stroke, dash: DASHED, width: 1.3 }]);
      }
      if (header) {
        const stroke = many ? LINES[p % LINES.length] : colour(header.controller || "accent");
        lines.push([name, episode.drawn(episode.latest, p), { stroke, width: 2 }]);
      }
    });
    const [low, high] = extent(...lines.map(([, values]) => values), ...(header?.ranges ?? []));
    const room = 0.08 * (high - low) || 0.1 * Math.abs(high) || 1;
    return {
      data: [
        Array.from({ length: count }, (_, i) => first + (count > 1 ? (i / (count - 1)) * (last - first) : 0)),
        ...lines.map(([, values]) => Array.from(values, (u) => (Number.isNaN(u) ? null : u))),
      ],
      series: lines.map(([label, , style]) => ({ label, ...style })),
      x: { label: axis.label, range: [0, length] },
      y: { label: panels.map((i) => facts.names[i] ?? "u").join(", "), range: [low - room, high + room] },
    };
  }

  function distances() {
    const { facts, episode } = model;
    const { header, panels } = episode;
    const columns = header?.columns ?? 0;
    const lists = panels.map((_, p) => Array.from({ length: columns }, (_, i) => episode.distance(i, p)));
    const [, high] = extent(...lists);
    return {
      data: [Array.from({ length: columns }, (_, i) => episode.time(episode.step(i))), ...lists],
      series: panels.map((i, p) => ({
        label: facts.names[i] ?? "u",
        stroke: panels.length > 1 ? LINES[p % LINES.length] : colour(header?.controller || "accent"),
        width: 2,
      })),
      x: { label: episode.timeLabel, range: header ? episode.span(facts.horizon) : [0, 1] },
      y: { label: "rms distance", range: [0, 1.08 * high || 1] },
    };
  }

  chart.update = () => {
    const { episode } = model;
    const { header, panels } = episode;
    let caption = "";
    if (header) {
      caption = header.sample_time ? `t = ${text(episode.time(header.last))} s` : `step ${header.last}`;
      const distance = panels.length === 1 ? episode.distance(header.columns - 1, 0) : null;
      if (distance !== null) caption += `, rms distance to the target ${text(distance)}`;
    }
    const shown = episode.plane ? distances() : curves();
    chart.show({ ...shown, caption, words: `${episode.plane ? "Distance" : "Profile"}${caption ? ` at ${caption}` : ": nothing yet"}` });
  };
  return chart;
}

export function curveChart(model) {
  const chart = new Chart("curve");

  // What it is compared with is in the picture unless it would squeeze the curve flat.
  function range({ low, high }, references) {
    let [bottom, top] = extent(low, high);
    if (!low.length) return extent(references);
    for (const value of references) {
      if (value < 1.6 * top && value > bottom / 1.6) [bottom, top] = [Math.min(bottom, value), Math.max(top, value)];
    }
    return [bottom, top];
  }

  function summary({ references: { lqt, adapted }, checked, diverged }) {
    const words = [];
    if (adapted === undefined && checked.lqt !== undefined) {
      const { none, lqt: first } = checked;
      const without = none === undefined ? "" : `${text(none)} without control, `;
      words.push(`check, on a field of its own: ${without}${text(first)} with ${model.controllers.lqt}`);
    }
    if (adapted !== undefined && lqt) {
      const share = 100 * (1 - adapted / lqt);
      const side = share >= 0 ? "below" : "above";
      words.push(`evaluated: ${text(adapted)}, ${Math.abs(share).toFixed(1)} % ${side} ${model.controllers.lqt}`);
    }
    if (diverged) words.push(`${diverged} rollout${diverged === 1 ? "" : "s"} diverged`);
    return words.join("; ");
  }

  chart.update = () => {
    const { curve: told, controllers } = model;
    const { x, mean, low, high, costs, axis, budget } = told;
    const last = x.length ? x[x.length - 1] : 0;
    let grown = 10; // in jumps, so that the curve stays where it is for a while
    while (grown < last) grown *= 2;
    const end = budget ? Math.max(budget, last) : grown;
    const references = ["none", "lqt", "adapted"].filter((name) => told.references[name] !== undefined);
    const [bottom, top] = range(told, references.map((name) => told.references[name]));
    const log = bottom > 0 && top / bottom > 6;
    const room = 0.12 * (top - bottom) || 0.5 * Math.abs(top) || 1;
    const span = log ? [bottom / 1.25, top * 1.25] : [bottom - room, top + room];
    const within = (list) => [null, ...list, null];
    const ends = [0, ...x, end];
    const seeds = costs.length <= MOST_SEEDS ? costs : [];
    const value = (_, v, __, i) =>
      i === null || v === null ? "" : `${text(v)} (${text(model.curve.low[i - 1])} to ${text(model.curve.high[i - 1])})`;
    const hidden = { class: "unnamed", stroke: "transparent", width: 0 };
    const flat = references.map((name) => {
      const cost = told.references[name];
      const outside = cost > span[1] ? ` ${text(cost)} ↑` : cost < span[0] ? ` ${text(cost)} ↓` : "";
      const label = `${controllers[name]}, evaluated${outside}`;
      return { label, stroke: colour(name), dash: name === "none" ? DOTTED : DASHED, width: 1.5 };
    });
    chart.show({
      data: [
        ends,
        within(high),
        within(low),
        ...seeds.map(within),
        ...references.map((name) => ends.map(() => told.references[name])),
        within(mean),
      ],
      series: [
        { label: "high", ...hidden },
        { label: "low", ...hidden },
        ...seeds.map((_, i) => ({ ...hidden, label: `seed ${told.seeds[i]}`, stroke: colour("seed"), width: 1 })),
        ...flat,
        { label: `while learning (band: ${told.band})`, stroke: colour("adapted"), width: 2, value, points: { show: x.length === 1 } },
      ],
      bands: [{ series: [1, 2], fill: colour("band") }],
      x: { label: axis, range: [0, end], whole: true },
      y: { label: "mean stage cost", range: span, log },
      caption: summary(told) || (x.length ? "" : "no rollout yet"),
      words: `Training: ${summary(told) || (x.length ? `${last} ${axis}, mean stage cost ${text(mean[mean.length - 1])}` : "nothing yet")}`,
    });
  };
  return chart;
}
