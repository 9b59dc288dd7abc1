// Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
// The picture of the field: in space and time, or of one on two axes at its first and newest instant,
// with its target beside it, where actuators act, and a bar of colours.

import { DARK, colour, text } from "./format.js";
import { css, pixels } from "./scale.js";

export const RIGHT = 104; // pixels to the right of a picture: of the target, the bar and its numbers
export const LEFT = 64; // and to the left, of the axis
const [TOP, BOTTOM, GAP, STRIP, BAR] = [8, 40, 14, 14, 12];
const FONT = '12px system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif';

// Round values within a range, about `count` of them.
export function ticks(low, high, count) {
  const raw = (high - low) / Math.max(1, count);
  const size = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].find((n) => n * size >= raw) * size;
  const first = Math.ceil(low / step - 1e-9);
  const last = Math.floor(high / step + 1e-9);
  return Array.from({ length: Math.min(50, Math.max(0, last - first + 1)) }, (_, i) => (first + i) * step);
}

// A picture of one pixel a value: value(row, column), row 0 below.
export function paint(rows, columns, [low, high], value) {
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [columns, rows];
  const context = canvas.getContext("2d");
  const image = context.createImageData(columns, rows);
  const painted = new Uint32Array(image.data.buffer);
  const colours = pixels();
  const scale = (colours.length - 1) / (high - low);
  for (let r = 0; r < rows; r++) {
    for (let i = 0; i < columns; i++) {
      const u = value(r, i);
      const k = Math.max(0, Math.min(colours.length - 1, Math.round((u - low) * scale)));
      if (!Number.isNaN(u)) painted[(rows - 1 - r) * columns + i] = colours[k];
    }
  }
  context.putImageData(image, 0, 0);
  return canvas;
}

// A bar of the colours from low to high, with numbers beside it.
export function bar(c, left, { y, h }, [low, high]) {
  for (let i = 0; i < h; i++) {
    c.fillStyle = css(1 - i / h);
    c.fillRect(left, y + i, BAR, 1.5);
  }
  c.font = FONT;
  c.fillStyle = colour("muted");
  c.textAlign = "left";
  for (const share of h > 90 ? [0, 0.25, 0.5, 0.75, 1] : [0, 0.5, 1]) {
    c.textBaseline = share === 0 ? "bottom" : share === 1 ? "top" : "middle";
    const u = low + share * (high - low);
    c.fillText(text(u, (high - low) / 40), left + BAR + 5, y + (1 - share) * h);
  }
}

// Where so many pictures of this size go in the room that there is, so that the first one, the newest
// field, is as large as can be: cells [column, row, size], pictures across, pixels of a metre.
function arranged(count, room, [x, y]) {
  const row = Array.from({ length: count }, (_, i) => [i, 0, 1]);
  const ways = [row];
  if (count === 2) ways.push([[0, 0, 1], [0, 1, 1]]);
  if (count === 3) ways.push([[0, 0, 2], [2, 0, 1], [2, 1, 1]]);
  const measured = ways.map((cells) => {
    const [across, down] = [0, 1].map((k) => Math.max(...cells.map((cell) => cell[k] + cell[2])));
    const scale = Math.min((room[0] - GAP * (across - 1)) / across / x, (room[1] - GAP * (down - 1)) / down / y);
    return { cells, across, scale };
  });
  return measured.reduce((best, way) => (way.scale * way.cells[0][2] > best.scale * best.cells[0][2] ? way : best));
}

export class FieldChart {
  constructor(model) {
    this.model = model;
    this.box = document.getElementById("field");
    this.output = document.getElementById("field-text");
    this.canvas = this.box.appendChild(document.createElement("canvas"));
    this.areas = []; // where something is drawn, and what is there: { x, y, w, h, say }
    new ResizeObserver(() => this.update()).observe(this.box);
    DARK.addEventListener("change", () => this.update());
    this.canvas.addEventListener("pointermove", (event) => this.point(event.offsetX, event.offsetY));
    this.canvas.addEventListener("pointerleave", () => this.point(-1, -1));
  }

  restyle() {
    this.update();
  }

  update() {
    this.request ??= requestAnimationFrame(() => {
      this.request = null;
      this.draw();
    });
  }

  // What the pointer is on, else what is shown.
  point(x, y) {
    this.pointer = [x, y];
    const on = this.areas.find((a) => x >= a.x && x < a.x + a.w && y >= a.y && y < a.y + a.h);
    const words = on?.say((x - on.x) / on.w, 1 - (y - on.y) / on.h) ?? this.caption;
    if (this.output.textContent !== words) this.output.textContent = words;
  }

  draw() {
    const { clientWidth: width, clientHeight: height } = this.box;
    if (!width || !height) return;
    const ratio = devicePixelRatio || 1;
    [this.canvas.width, this.canvas.height] = [width * ratio, height * ratio];
    const c = this.canvas.getContext("2d");
    c.scale(ratio, ratio);
    c.font = FONT;
    c.imageSmoothingEnabled = false;
    this.areas = [];
    this.describe();
    const { episode } = this.model;
    if (episode.plane) this.planes(c, width, height);
    else this.lines(c, width, height);
    this.point(...(this.pointer ?? [-1, -1]));
  }

  describe() {
    const { facts, controllers, episode } = this.model;
    const { header } = episode;
    const names = episode.panels.map((i) => facts.names[i] ?? "u").join(", ");
    this.caption = episode.target.length ? `${names}: no state yet, only the target` : "no state yet";
    let words = "Field in space and time: nothing yet";
    if (header) {
      const number = header.episode % 2 ** 32; // the rest counts the restarts of the tuner
      const who = header.controller ? ` (${controllers[header.controller] ?? header.controller})` : "";
      const [low, high] = header.ranges[0];
      this.caption = `${names}, episode ${number}${who}, step ${header.last}`;
      words =
        `Field ${names} of episode ${number}, environment ${header.environment}, up to step ` +
        `${header.last}, values from ${text(low)} to ${text(high)}`;
    }
    this.box.setAttribute("aria-label", words);
  }

  // Fields on one axis, or numbers, over time: a panel for each component.
  lines(c, width, height) {
    const { episode, facts } = this.model;
    const { header, panels } = episode;
    const axis = facts.axes[0];
    const rows = episode.rows || 1;
    const length = axis.length || rows;
    const [first, last] = axis.length ? (axis.ends ?? [0, (length * (rows - 1)) / rows]) : [0.5, rows - 0.5];
    const half = rows > 1 ? (last - first) / (rows - 1) / 2 : length / 2;
    const span = header ? episode.span(facts.horizon) : [0, 1];
    const w = Math.max(40, width - LEFT - RIGHT);
    const whole = (height - TOP - BOTTOM - GAP * (panels.length - 1)) / panels.length;
    const path = episode.pathColumns; // a moving target is a picture below the field
    const h = path ? (whole - GAP) / 2 : whole;
    panels.forEach((component, p) => {
      const area = { x: LEFT, y: TOP + p * (whole + GAP), w, h };
      const [low, high] = episode.range(p);
      const up = (u) => area.y + h * (1 - u / length);
      const at = (t) => area.x + (w * (t - span[0])) / (span[1] - span[0]);
      c.save();
      c.beginPath();
      c.rect(area.x, area.y, w, h);
      c.clip();
      c.fillStyle = colour("blank");
      c.fillRect(area.x, area.y, w, h);
      const place = [up(last + half), (h * 2 * half * rows) / length]; // from the top, and how high
      if (header) {
        const { columns } = header;
        const picture = paint(rows, columns, [low, high], (r, i) => episode.value(i, p, r));
        const from = at(episode.time(episode.step(0)));
        c.drawImage(picture, from, place[0], at(episode.time(episode.step(columns))) - from, place[1]);
      }
      this.marks(c, component, (low, high) => {
        c.fillRect(area.x, up(high), 5, up(low) - up(high));
      }, length);
      c.restore();
      const target = episode.ofTarget(p);
      const foot = path ? { ...area, y: area.y + h + GAP } : area;
      if (path) {
        const picture = paint(rows, path, [low, high], (r, i) => episode.wanted(i, p, r));
        const from = at(episode.time(episode.step(0)));
        c.save();
        c.beginPath();
        c.rect(foot.x, foot.y, w, h);
        c.clip();
        c.drawImage(picture, from, place[0] + h + GAP, at(episode.time(episode.step(path))) - from, place[1]);
        this.tag(c, foot, "target");
        c.restore();
        this.axisY(c, foot, length, "");
      } else if (target.length) {
        c.save();
        c.beginPath();
        c.rect(area.x + w + 6, area.y, STRIP, h);
        c.clip();
        c.drawImage(paint(rows, 1, [low, high], (r) => target[r]), area.x + w + 6, place[0], STRIP, place[1]);
        c.restore();
        c.fillStyle = colour("muted");
        c.textAlign = "center";
        c.textBaseline = "top";
        if (p === panels.length - 1) c.fillText("target", area.x + w + 6 + STRIP / 2, area.y + h + 22);
      }
      bar(c, area.x + w + 6 + STRIP + 8, area, [low, high]);
      const name = panels.length > 1 ? `${facts.names[component] ?? ""}:  ${axis.label}` : axis.label;
      this.axisY(c, area, length, name);
      if (p === panels.length - 1) this.axisX(c, foot, span, header ? episode.timeLabel : "t (s)");
      const say = (a, b) => {
        const time = span[0] + a * (span[1] - span[0]);
        const column = Math.floor((time / (header?.sample_time || 1) - header?.begin) / header?.stride);
        const row = Math.min(rows - 1, Math.floor(b * rows));
        if (!header || column < 0 || column >= header.columns) return undefined;
        const where = axis.length ? text(b * length) : row + 1;
        const u = text(episode.value(column, p, row));
        return `t ${text(time)}, ${axis.label.split(" ")[0]} ${where}: ${facts.names[component]} = ${u}`;
      };
      this.areas.push({ ...area, say });
    });
  }

  // Fields on two axes: each component at its newest and its first instant, and its target.
  planes(c, width, height) {
    const { episode, facts } = this.model;
    const { header, panels, plane } = episode;
    const [rows, columns] = plane;
    const [y, x] = facts.axes.length > 1 ? facts.axes : [{ label: "", length: rows }, { label: "", length: columns }];
    const time = (step) => (header.sample_time ? `t = ${text(episode.time(step))} s` : `step ${step}`);
    const shown = [];
    if (header) shown.push([time(header.last), (p) => episode.drawn(episode.latest, p)]);
    if (header && width > 480) shown.push([time(header.begin), (p) => episode.drawn(episode.initial, p)]);
    if (episode.target.length) shown.push(["target", (p) => episode.ofTarget(p)]);
    if (!shown.length) return;
    const room = [width - LEFT - 74, (height - TOP - BOTTOM - GAP * (panels.length - 1)) / panels.length];
    const { cells, across, scale } = arranged(shown.length, room, [x.length, y.length]);
    const [w, h] = [x.length * scale, y.length * scale];
    const tall = Math.max(...cells.map(([, row, size]) => row + size));
    panels.forEach((component, p) => {
      const name = panels.length > 1 ? `${facts.names[component] ?? ""}:  ${y.label}` : y.label;
      const top = TOP + p * (room[1] + GAP);
      shown.forEach(([title, values], s) => {
        const [column, row, size] = cells[s];
        const area = { x: LEFT + column * (w + GAP), y: top + row * (h + GAP) };
        Object.assign(area, { w: size * w + (size - 1) * GAP, h: size * h + (size - 1) * GAP });
        const own = values(p);
        c.save();
        c.beginPath();
        c.rect(area.x, area.y, area.w, area.h);
        c.clip();
        c.drawImage(
          paint(rows, columns, episode.range(p), (r, i) => own[r * columns + i]),
          ...[area.x, area.y, area.w, area.h],
        );
        this.boxes(c, component, area, [y, x]);
        this.tag(c, area, title);
        c.restore();
        c.strokeStyle = colour("muted");
        c.strokeRect(area.x, area.y, area.w, area.h);
        if (column === 0) this.axisY(c, area, y.length, name);
        if (column === 0 && row + size === tall && p === panels.length - 1) this.axisX(c, area, [0, x.length], x.label);
        const say = (a, b) => {
          const [i, r] = [Math.min(columns - 1, Math.floor(a * columns)), Math.min(rows - 1, Math.floor(b * rows))];
          const u = text(own[r * columns + i]);
          return `${title}, (${text(a * x.length)}, ${text(b * y.length)}): ${facts.names[component]} = ${u}`;
        };
        this.areas.push({ ...area, say });
      });
      bar(c, LEFT + across * (w + GAP) - 4, { y: top, h: tall * (h + GAP) - GAP }, episode.range(p));
    });
  }

  // What a picture shows, in its corner.
  tag(c, { x, y }, words) {
    c.fillStyle = colour("panel");
    c.globalAlpha = 0.8;
    c.fillRect(x, y, c.measureText(words).width + 10, 18);
    c.globalAlpha = 1;
    c.fillStyle = colour("text");
    c.textAlign = "left";
    c.textBaseline = "middle";
    c.fillText(words, x + 5, y + 10);
  }

  // Call draw(low, high) for each actuator of a component on one axis; around a ring it is there twice.
  marks(c, component, draw, length) {
    this.model.facts.actuators
      .filter((box) => box.component === component)
      .forEach(({ sides: [[low, high]] }, j) => {
        c.fillStyle = colour(j % 2 ? "text" : "muted");
        draw(low, high);
        if (low < 0) draw(low + length, high + length);
      });
  }

  // The outlines of the actuators of a component on a plane.
  boxes(c, component, area, [y, x]) {
    c.strokeStyle = colour("text");
    for (const { component: own, sides } of this.model.facts.actuators) {
      if (own !== component || sides.length < 2) continue;
      for (const dx of sides[1][0] < 0 ? [0, x.length] : [0]) {
        for (const dy of sides[0][0] < 0 ? [0, y.length] : [0]) {
          const [left, right] = sides[1].map((v) => area.x + (area.w * (v + dx)) / x.length);
          const [below, above] = sides[0].map((v) => area.y + area.h * (1 - (v + dy) / y.length));
          c.strokeRect(left, above, right - left, below - above);
        }
      }
    }
  }

  axisX(c, { x, y, w, h }, [low, high], label) {
    c.fillStyle = colour("muted");
    c.textAlign = "center";
    c.textBaseline = "top";
    const values = ticks(low, high, w / 80);
    const step = values[1] - values[0] || 0;
    for (const v of values) c.fillText(text(v, step), x + (w * (v - low)) / (high - low), y + h + 5);
    c.fillText(label, x + w / 2, y + h + 22);
  }

  axisY(c, { x, y, h }, length, label) {
    c.fillStyle = colour("muted");
    c.textAlign = "right";
    c.textBaseline = "middle";
    const values = ticks(0, length, h / 40);
    const step = values[1] - values[0] || 0;
    for (const v of values) c.fillText(text(v, step), x - 6, y + h * (1 - v / length));
    c.save();
    c.translate(x - 50, y + h / 2);
    c.rotate(-Math.PI / 2);
    c.textAlign = "center";
    c.fillText(label, 0, 0);
    c.restore();
  }
}
