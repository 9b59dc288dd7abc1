// Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
// What was seen of the shown episode, and its picture in space and time.

import { css, pixels } from "./scale.js";
import { Chart } from "./chart.js";
import { colour, text } from "./format.js";

const BAR = 12; // width of the colour bar

// The samples of the shown episode: columns are steps, rows grid points.
export class Episode {
  header = null;
  fields = new Float32Array(0);
  actions = new Float32Array(0);
  latest = new Float32Array(0);
  target = new Float32Array(0);

  take(header, numbers) {
    const split = header.rows * header.columns;
    const end = split + header.actions * header.columns;
    this.fields = numbers.subarray(0, split);
    this.actions = numbers.subarray(split, end);
    this.latest = numbers.subarray(end);
    this.header = header;
  }

  // Time since the start of the episode of a step; steps where the time is not known.
  time(step) {
    return step * (this.header?.sample_time || 1);
  }

  get timeLabel() {
    return this.header?.sample_time ? "t (s)" : "step";
  }

  step(column) {
    return this.header.begin + column * this.header.stride;
  }

  // [first, last] time of the axis: to the horizon where it is known.
  span(horizon) {
    const { begin, last, ended } = this.header;
    const end = ended ? last : Math.max(last, horizon || 1.25 * last, begin + 1);
    return [this.time(begin), this.time(Math.max(end, begin + 1))];
  }

  value(column, row) {
    return this.fields[column * this.header.rows + row];
  }
}

export function fieldChart(model) {
  const picture = document.createElement("canvas");

  // One pixel a sample.
  function render({ fields, header: { rows, columns, range } }) {
    picture.width = columns;
    picture.height = rows;
    const paint = picture.getContext("2d");
    const image = paint.createImageData(columns, rows);
    const painted = new Uint32Array(image.data.buffer);
    const colours = pixels();
    const [low, high] = range;
    const scale = (colours.length - 1) / (high - low);
    for (let i = 0; i < columns; i++) {
      for (let r = 0; r < rows; r++) {
        const u = fields[i * rows + r];
        const k = Math.max(0, Math.min(colours.length - 1, Math.round((u - low) * scale)));
        if (!Number.isNaN(u)) painted[(rows - 1 - r) * columns + i] = colours[k];
      }
    }
    paint.putImageData(image, 0, 0);
  }

  // Into uPlot's canvas, in its pixels, below the axes.
  function drawPicture(plot) {
    const { episode } = model;
    if (!episode.header) return;
    render(episode);
    const { ctx: c, bbox: box } = plot;
    const { columns, rows } = episode.header;
    const start = plot.valToPos(episode.time(episode.step(0)), "x", true);
    const end = plot.valToPos(episode.time(episode.step(columns)), "x", true);
    c.save();
    c.beginPath();
    c.rect(box.left, box.top, box.width, box.height);
    c.clip();
    c.fillStyle = colour("blank");
    c.fillRect(box.left, box.top, box.width, box.height);
    c.imageSmoothingEnabled = false;
    c.drawImage(picture, 0, 0, columns, rows, start, box.top, end - start, box.height);
    c.restore();
  }

  function drawBar(plot) {
    if (!model.episode.header) return;
    const { ctx: c, bbox: box } = plot;
    const px = uPlot.pxRatio;
    const left = box.left + box.width + 12 * px;
    c.save();
    for (let y = 0; y < box.height; y++) {
      c.fillStyle = css(1 - y / box.height);
      c.fillRect(left, box.top + y, BAR * px, 1.5);
    }
    const [low, high] = model.episode.header.range;
    c.fillStyle = colour("muted");
    c.textAlign = "left";
    c.font = `${12 * px}px system-ui, "DejaVu Sans", sans-serif`;
    for (const share of [0, 0.25, 0.5, 0.75, 1]) {
      c.textBaseline = share === 0 ? "bottom" : share === 1 ? "top" : "middle";
      const u = low + share * (high - low);
      c.fillText(text(u, (high - low) / 40), left + (BAR + 5) * px, box.top + (1 - share) * box.height);
    }
    c.restore();
  }

  // What the pointer is on.
  function point(plot) {
    const { left, top } = plot.cursor;
    const { facts, episode } = model;
    const { header } = episode;
    chart.pointed = false;
    if (header && left >= 0 && top >= 0) {
      const [t, x] = [plot.posToVal(left, "x"), plot.posToVal(top, "y")];
      const { rows, begin, stride, sample_time: dt } = header;
      const column = Math.floor((t / (dt || 1) - begin) / stride);
      const row = Math.min(rows - 1, Math.floor((x / (facts.length || rows)) * rows));
      if (column >= 0 && column < header.columns && row >= 0) {
        chart.pointed = true;
        chart.say(`t ${text(t)}, x ${text(x)}: ${facts.name} = ${text(episode.value(column, row))}`);
      }
    }
    if (!chart.pointed) chart.say(chart.shown.caption);
  }

  const hooks = { drawClear: [drawPicture], draw: [drawBar], setCursor: [point] };
  const chart = new Chart("field", { right: 74, legend: false, grid: false, hooks });

  chart.update = () => {
    const { facts, controllers, episode } = model;
    const { header } = episode;
    const range = header ? episode.span(facts.horizon) : [0, 1];
    let [caption, words] = ["no state has come yet", "Field in space and time: nothing yet"];
    if (header) {
      const number = header.episode % 2 ** 32; // the rest counts the restarts of the tuner
      const who = header.controller ? ` (${controllers[header.controller] ?? header.controller})` : "";
      caption = `${facts.name}(x, t), episode ${number}${who}, step ${header.last}`;
      words =
        `Field ${facts.name}(x, t) of episode ${number}, environment ${header.environment}, up to step ` +
        `${header.last}, values from ${text(header.range[0])} to ${text(header.range[1])}`;
    }
    chart.show({
      data: [range, [null, null]],
      series: [{ label: facts.name }],
      x: { label: header ? episode.timeLabel : "t (s)", range },
      y: {
        label: facts.length ? "x (m)" : "grid point",
        range: [0, facts.length || Math.max(1, header ? header.rows - 1 : 1)],
      },
      caption,
      words,
    });
  };
  return chart;
}
