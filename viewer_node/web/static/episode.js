// Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
// What was seen of the shown episode, and the target.

const NOTHING = new Float32Array(0);

// Columns are steps; each holds `rows` numbers of every panel, a component that is shown. A field on two
// axes has, besides, the pictures of its first and newest state, `plane` rows and columns each.
export class Episode {
  header = null;
  panels = [0];
  plane = null;
  rows = 0;
  fields = NOTHING;
  actions = NOTHING;
  latest = NOTHING;
  initial = NOTHING;
  target = NOTHING; // as it is drawn
  targetRows = NOTHING; // and at the numbers of a column
  moving = null; // where the target moves: { header, numbers }, its numbers of every column

  take(header, numbers) {
    const { panels, plane, rows, columns } = header;
    const drawn = panels.length * (plane ? plane[0] * plane[1] : rows);
    const split = panels.length * rows * columns;
    const end = split + header.actions * columns;
    this.fields = numbers.subarray(0, split);
    this.actions = numbers.subarray(split, end);
    this.latest = numbers.subarray(end, end + drawn);
    this.initial = numbers.subarray(end + drawn);
    Object.assign(this, { header, panels, plane, rows });
  }

  takeTarget({ panels, plane, rows }, numbers) {
    const drawn = panels.length * (plane ? plane[0] * plane[1] : rows);
    this.target = numbers.subarray(0, drawn);
    this.targetRows = numbers.subarray(drawn);
    Object.assign(this, { panels, plane, rows });
  }

  takePath(header, numbers) {
    this.moving = { header, numbers };
  }

  // The moving target's columns, while they are of the shown panels and steps; 0 of a constant one.
  get pathColumns() {
    if (!this.moving || !this.header) return 0;
    const { columns, begin, stride, panels } = this.moving.header;
    const fits = begin === this.header.begin && stride === this.header.stride && `${panels}` === `${this.panels}`;
    return fits ? columns : 0;
  }

  wanted(column, panel, row) {
    if (!this.pathColumns) return this.targetRows[panel * this.rows + row];
    const i = Math.min(column, this.pathColumns - 1);
    return this.moving.numbers[(i * this.panels.length + panel) * this.rows + row];
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

  value(column, panel, row) {
    return this.fields[(column * this.panels.length + panel) * this.rows + row];
  }

  // Of a state as it is drawn the part of a panel.
  drawn(state, panel) {
    const size = state.length / this.panels.length;
    return state.subarray(panel * size, (panel + 1) * size);
  }

  ofTarget(panel) {
    return this.drawn(this.target, panel);
  }

  // The range of a panel's colours; before the first state that of its target.
  range(panel) {
    if (this.header) return this.header.ranges[panel];
    const largest = this.ofTarget(panel).reduce((most, u) => Math.max(most, Math.abs(u)), 0) || 1;
    return [-largest, largest];
  }

  // Root of the mean square of the distance to the target in a column, where both are known.
  distance(column, panel) {
    if (this.targetRows.length !== this.rows * this.panels.length) return null;
    let sum = 0;
    for (let r = 0; r < this.rows; r++) {
      sum += (this.value(column, panel, r) - this.wanted(column, panel, r)) ** 2;
    }
    return Number.isNaN(sum) ? null : Math.sqrt(sum / this.rows);
  }
}
