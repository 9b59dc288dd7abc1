// The live page: what comes over the link goes into the charts and the panel.

import { actionsPlot, curvePlot, profilePlot } from "./charts.js";
import { Episode, fieldPlot } from "./field.js";
import { Link } from "./link.js";
import { Panel } from "./panel.js";

const EMPTY = { axis: "iteration", phase: "", total: 0, band: "seeds", references: {}, points: [] };

const episode = new Episode();
const facts = { length: 0, horizon: 0, n_a: 0, name: "u" }; // of the loop, as far as its nodes told
const curve = { told: EMPTY };
let status = null;

const panel = new Panel(() => link);
const field = fieldPlot(episode, facts);
const actions = actionsPlot(episode, facts);
const profile = profilePlot(episode, facts);
const training = curvePlot(curve);
const ofEpisode = [field, actions, profile];

function redraw(plots) {
  for (const plot of plots) plot.redraw();
}

const take = {
  status(message) {
    const moved = status && status.place.begun !== message.place.begun;
    status = message;
    const { length = 0, horizon = 0, n_a = 0 } = message.parameters;
    const changed = facts.length !== length || facts.horizon !== horizon || facts.name !== message.components[message.component];
    const name = message.components[message.component];
    Object.assign(facts, { length, horizon, n_a, name });
    panel.status(message, curve);
    if (moved) Object.assign(episode, new Episode());
    if (changed || moved) redraw(ofEpisode);
  },
  curve(message) {
    curve.told = message;
    if (status) panel.figures(status, curve);
    redraw([training]);
  },
  target(message, numbers) {
    episode.target = numbers.slice();
    redraw([profile]);
  },
  episode(message, numbers) {
    episode.take(message, numbers);
    redraw(ofEpisode);
  },
};

const link = new Link(
  (header, numbers) => take[header.part]?.(header, numbers),
  (yes) => panel.connected(yes),
);
redraw([...ofEpisode, training]);
