// Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
// The live page: what comes over the link goes into the charts and the page around them.

import { actionsChart, curveChart, profileChart } from "./charts.js";
import { Episode } from "./episode.js";
import { FieldChart } from "./field.js";
import { Link } from "./link.js";
import { showPage } from "./page.js";

const CONFIRM = 5000; // ms in which a second click confirms
const NOTICE = 10000; // ms for which a notice of the page's own stays

// All that the page shows.
const model = {
  episode: new Episode(),
  curve: null, // as the monitor tells it, like the status
  status: null,
  controllers: {}, // names, by key
  facts: { axes: [{ label: "grid point", length: 0 }], actuators: [], horizon: 0, n_a: 0, bounds: null, names: ["u"] }, // as told
  connected: null,
  notice: "",
  called: null, // "role/verb" of the button that was pressed, until the next status
  confirming: false, // whether a second click on Stop is awaited
};

// Change the model, and show it.
function set(changes) {
  Object.assign(model, changes);
  showPage(model, { press, choose: (what) => link.send(what) });
}

set({});
const training = curveChart(model);
const ofEpisode = [new FieldChart(model), actionsChart(model), profileChart(model)];

function update(charts) {
  for (const chart of charts) chart.update();
}

const take = {
  hello({ controllers }) {
    for (const [key, [name, light, dark]] of Object.entries(controllers)) {
      model.controllers[key] = name;
      document.documentElement.style.setProperty(`--${key}`, `light-dark(${light}, ${dark})`);
    }
    for (const chart of [training, ...ofEpisode]) chart.restyle();
  },
  status(status) {
    const { axes = model.facts.axes, places = {}, horizon = 0, n_a = 0, bounds = null } = status.parameters;
    const facts = { axes, actuators: places.actuators ?? [], horizon, n_a, bounds, names: status.components };
    if (model.status?.place.begun !== status.place.begun) model.episode = new Episode();
    set({ status, facts, called: null });
    update(ofEpisode);
  },
  curve(curve) {
    set({ curve });
    update([training]);
  },
  target(header, numbers) {
    model.episode.takeTarget(header, numbers);
    update(ofEpisode);
  },
  path(header, numbers) {
    model.episode.takePath(header, numbers);
    update(ofEpisode);
  },
  episode(header, numbers) {
    model.episode.take(header, numbers);
    update(ofEpisode);
  },
  refusal({ text }) {
    set({ notice: text });
    setTimeout(() => set({ notice: "" }), NOTICE);
  },
};

const link = new Link(
  (header, numbers) => take[header.part]?.(header, numbers),
  (connected) => set({ connected }),
);
update(ofEpisode);

// Call a service of a node; one that stops the training is to be confirmed.
function press(node, role, verb) {
  const confirmed = verb !== "stop" || model.confirming;
  set({ confirming: !confirmed });
  if (confirmed) {
    set({ called: `${role}/${verb}` });
    link.send({ node, verb });
  } else {
    setTimeout(() => set({ confirming: false }), CONFIRM);
  }
}
