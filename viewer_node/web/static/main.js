// The live page: what comes over the link goes into the charts and the panel.

import { actionsChart, curveChart, profileChart } from "./charts.js";
import { Episode, fieldChart } from "./field.js";
import { Link } from "./link.js";
import { Panel } from "./panel.js";
import { Replay } from "./replay.js";

const EMPTY = {
  ...{ axis: "rollouts", phase: "", budget: 0, band: "seeds", diverged: 0, paid: [0, 0] },
  ...{ seeds: [], references: {}, evaluations: {}, x: [], mean: [], low: [], high: [], costs: [] },
};

const episode = new Episode();
const facts = { length: 0, horizon: 0, n_a: 0, name: "u" }; // of the loop, as far as its nodes told
const curve = { told: EMPTY };
const controllers = {}; // names, by key
let status = null;

const panel = new Panel(() => link);
const training = curveChart(curve, controllers);
const ofEpisode = [fieldChart(episode, facts, controllers), actionsChart(episode, facts), profileChart(episode, facts)];

function update(charts) {
  for (const chart of charts) chart.update();
}

const replay = new Replay(
  episode,
  () => update(ofEpisode),
  (index) => panel.request({ episode: index }),
);

const take = {
  hello(message) {
    const { style } = document.documentElement;
    for (const [key, [name, light, dark]] of Object.entries(message.controllers)) {
      controllers[key] = name;
      style.setProperty(`--${key}-light`, light);
      style.setProperty(`--${key}-dark`, dark);
    }
    for (const chart of [training, ...ofEpisode]) chart.restyle();
  },
  status(message) {
    const moved = status && status.place.begun !== message.place.begun;
    status = message;
    const { length = 0, horizon = 0, n_a = 0 } = message.parameters;
    const name = message.components[message.component];
    const changed = facts.length !== length || facts.horizon !== horizon || facts.name !== name;
    Object.assign(facts, { length, horizon, n_a, name });
    if (moved) {
      Object.assign(episode, new Episode());
      curve.told = EMPTY;
    }
    panel.status(message, curve);
    replay.status(message.recorded);
    if (changed || moved) update(ofEpisode);
  },
  curve(message) {
    curve.told = message;
    if (status) panel.figures(status, curve);
    panel.seeds(message, controllers);
    update([training]);
  },
  target(message, numbers) {
    episode.target = numbers.slice();
    update(ofEpisode.slice(2));
  },
  episode(message, numbers) {
    episode.take(message, numbers);
    if (message.new) replay.begin();
    update(ofEpisode);
  },
};

const link = new Link(
  (header, numbers) => take[header.part]?.(header, numbers),
  (yes) => panel.connected(yes),
);
update([...ofEpisode, training]);
