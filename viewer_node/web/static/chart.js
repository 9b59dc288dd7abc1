// Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
// A chart in the page's colours, drawn by uPlot (vendor/uplot) at most once a frame.

import { DARK, colour, text } from "./format.js";

const FONT = "12px system-ui, 'Segoe UI', Roboto, 'DejaVu Sans', sans-serif";
const SPACE_X = 70; // pixels between two labels of an axis, at least
const SPACE_Y = 34;
const MOST_NAMES = 40; // lines below the chart, with the hidden ones

// A value in the legend, where the pointer is.
function shortly(_, value) {
  return value === null || value === undefined ? "" : text(value);
}

// Of the steps of a logarithmic axis those that have a label.
function oneTwoFive(value) {
  const leading = value / 10 ** Math.floor(Math.log10(value) + 1e-9);
  return [1, 2, 5].some((n) => Math.abs(leading - n) < 1e-6) ? value : null;
}

export class Chart {
  // id: of the element that it fills; right: pixels kept free there; hooks: of uPlot.
  constructor(id, { right = 14, legend = true, grid = true, hooks = {} } = {}) {
    this.box = document.getElementById(id);
    this.output = document.getElementById(`${id}-text`);
    Object.assign(this, { right, legend, grid, hooks });
    new ResizeObserver(() => this.resize()).observe(this.box);
    DARK.addEventListener("change", () => this.restyle());
  }

  // data: x and a list for each of `series`, as uPlot takes them; x, y: { label, range, log, whole };
  // caption: stands beside the title; words: the whole for who cannot see it.
  show(shown) {
    this.shown = shown;
    this.request ??= requestAnimationFrame(() => {
      this.request = null;
      this.draw();
    });
  }

  restyle() {
    this.look = "";
    if (this.shown) this.show(this.shown);
  }

  say(words) {
    if (this.output.textContent !== words) this.output.textContent = words;
  }

  draw() {
    const { data, series, x, y, caption = "", words = caption } = this.shown;
    if (!this.box.clientWidth) return;
    const look = JSON.stringify([series, x.label, x.whole, y.label, y.whole, y.log, DARK.matches]);
    if (look !== this.look) this.build(look);
    else this.plot.setData(data);
    if (!this.pointed) this.say(caption);
    this.box.setAttribute("aria-label", words);
  }

  build(look) {
    const { data, series, bands = [], x, y } = this.shown;
    this.plot?.destroy();
    this.look = look;
    const axis = (label, space, more) => ({
      label,
      labelSize: 18,
      labelFont: FONT,
      font: FONT,
      stroke: colour("muted"),
      grid: { show: this.grid, stroke: colour("grid"), width: 1 },
      ticks: { show: false },
      gap: 6,
      space,
      ...more,
    });
    const options = {
      ...this.size(0),
      padding: [8, this.right, 0, 0],
      legend: {
        show: this.legend && series.length <= MOST_NAMES && series.some(({ label }) => label),
        markers: {
          width: 2,
          stroke: (plot, i) => plot.series[i].stroke(plot, i),
          dash: (plot, i) => (plot.series[i].dash ? "dashed" : "solid"),
        },
      },
      cursor: { y: false, points: { size: 6 }, drag: { x: false, y: false } },
      scales: {
        x: { time: false, range: () => this.shown.x.range },
        y: { distr: y.log ? 3 : 1, range: () => this.shown.y.range },
      },
      axes: [
        axis(x.label, SPACE_X, {
          size: 26,
          values: (_, at) => at.map((v) => (x.whole && v % 1 ? "" : text(v))),
        }),
        axis(y.label, SPACE_Y, {
          size: 46,
          values: (_, at) => at.map((v) => (v === null || (y.whole && v % 1) ? "" : text(v))),
          ...(y.log ? { filter: (_, at) => at.map(oneTwoFive) } : {}),
        }),
      ],
      series: [
        { label: x.label, value: shortly },
        ...series.map(({ steps, ...one }) => ({
          points: { show: false },
          value: shortly,
          ...(steps ? { paths: uPlot.paths.stepped({ align: 1 }) } : {}),
          ...one,
        })),
      ],
      bands,
      hooks: this.hooks,
    };
    this.plot = new uPlot(options, data, this.box);
    this.resize();
  }

  size(taken) {
    return { width: this.box.clientWidth, height: Math.max(80, this.box.clientHeight - taken) };
  }

  resize() {
    if (!this.plot || !this.box.clientWidth) {
      if (this.shown) this.show(this.shown);
      return;
    }
    const legend = this.box.querySelector(".u-legend");
    const { width, height } = this.size(legend ? legend.offsetHeight : 0);
    if (this.plot.width !== width || this.plot.height !== height) this.plot.setSize({ width, height });
  }
}
