// Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
// The page around the charts: its markup as functions of the model, rendered by Preact.

import htm from "./htm.mjs";
import { h, render } from "./preact.mjs";
import { duration, text } from "./format.js";

const html = htm.bind(h);

const STATES = {
  searching: ["", "looking for a training", "No training runs on this machine. Start one: pdeloop train burgers"],
  empty: ["warn", "no nodes", "No node publishes the loop's topics in this domain and namespace."],
  waiting: ["warn", "waiting for the first message", ""],
  running: ["good", "running", ""],
  silent: ["warn", "no messages", ""],
  paused: ["warn", "paused", ""],
  ended: ["", "ended", ""],
};
const BUTTONS = { plant: ["pause", "resume", "step"], tuner: ["pause", "resume", "stop"] };
const VERBS = {
  pause: ["Pause", "Pausing…", "hold it where it is"],
  resume: ["Resume", "Resuming…", "continue"],
  step: ["Step", "Stepping…", "one step, then pause again"],
  stop: ["Stop", "Stopping…", "end after this iteration"],
};
const PHASES = {
  identify: "exploring the plant",
  check: "checking the first law",
  adapt: "improving the law",
  evaluate: "comparing on held-out fields",
  done: "finished",
  policy: "running laws",
  compare: "comparing controllers",
};
const COMPARED = ["none", "lqt", "adapted"];
const ROLES = { plant: "plant", tuner: "training" };
const LEVELS = ["good", "warn", "bad", "warn"];

// actions: press(node, role, verb), choose(what).
export function showPage(model, actions) {
  const { status, curve } = model;
  const known = status && curve;
  document.title = `${status?.parameters.problem ?? "pdeloop"} – ${doing(model)[1]} – pdeloop`;
  render(
    html`
      <header>
        <${Title} ...${model} />
        ${known && html`<${Controls} ...${model} ...${actions} />`}
      </header>
      ${known && html`<${Notice} ...${model} /><${Result} ...${model} />`}
      <main>
        <${Panel} id="field" title="Field" before=${known && html`<${Choices} ...${model} ...${actions} />`} />
        <${Panel} id="actions" title=${html`Actions <i>a</i><sub>j</sub>(<i>t</i>)`} />
        <${Panel} id="profile" title=${model.facts.axes.length > 1 ? "Distance to the target" : "Profile and target"} />
        <${Panel} id="curve" title="Training" />
        ${known && html`<${Seeds} ...${model} />`}
        ${known && html`<${Nodes} ...${model} />`}
      </main>
    `,
    document.body,
  );
}

// A panel with a chart, which fills `.plot` and says in `output` what it shows.
function Panel({ id, title, before }) {
  return html`
    <section class="panel ${id}" aria-labelledby="${id}-title">
      <div class="head">
        <h2 id="${id}-title">${title}</h2>
        <output id="${id}-text" class="muted"></output>
        ${before}
      </div>
      <div class="plot" id=${id} role="img"></div>
    </section>
  `;
}

// Class and words of the state: what the nodes compute says more than that they are silent.
function doing({ status, connected }) {
  if (connected === false) return ["bad", "no connection to the monitor"];
  if (!status) return ["", "connecting"];
  const { state, paused, activity, quiet, stopping } = status;
  const [className, words] = STATES[state] ?? ["", state];
  if (state === "paused") return [className, `${paused.map((role) => ROLES[role]).join(" and ")} paused`];
  const busy = state === "running" || state === "silent" || state === "waiting";
  if (busy && activity) return ["good", `${activity.what}, ${duration(activity.seconds)}`];
  if (state === "silent") return [className, `${words} for ${duration(quiet ?? 0)}`];
  if (state === "running" && stopping) return [className, "stopping"];
  return [className, words];
}

function Title(model) {
  const { place = {}, parameters = {} } = model.status ?? {};
  const [className, words] = doing(model);
  const domain = Number.isInteger(place.domain) ? `ROS domain ${place.domain}` : "";
  const namespace = place.namespace === "/" ? "" : place.namespace;
  return html`
    <div class="title">
      <h1 id="problem">${parameters.problem ?? "pdeloop"}</h1>
      <span id="state" class="pill ${className}" role="status" aria-live="polite">${words}</span>
      <span id="place" class="muted">${[place.folder, domain, namespace].filter(Boolean).join(" · ")}</span>
    </div>
  `;
}

function Controls(model) {
  return html`
    <div id="controls" class="controls" role="group" aria-label="Control of the loop">
      ${Object.entries(BUTTONS).map(
        ([role, verbs]) => html`
          <div class="group">
            <span>${ROLES[role]}</span>
            ${verbs.map((verb) => html`<${Button} role=${role} verb=${verb} ...${model} />`)}
          </div>
        `,
      )}
    </div>
  `;
}

function Button({ role, verb, status, connected, called, confirming, press }) {
  const [name, going, meaning] = VERBS[verb];
  const offer = status.controls.find((c) => c.role === role && c.verbs.includes(verb));
  const asked = status.requests.some((r) => r.role === role && r.verb === verb && !r.failure);
  const under = asked || (verb === "stop" && status.stopping);
  const sure = verb === "stop" && confirming;
  return html`
    <button
      id="${role}-${verb}"
      class=${sure ? "sure" : ""}
      disabled=${!offer || !connected || under || called === `${role}/${verb}`}
      aria-label="${name} ${ROLES[role]}: ${meaning}"
      title=${offer ? `${meaning} (${offer.node}/${verb})` : `no ${role} offers the service ~/${verb}`}
      onClick=${() => press(offer.node, role, verb)}
    >
      ${sure ? "Really stop?" : under ? going : name}
    </button>
  `;
}

// What stands below the title is a function of the newest status, so that nothing old stays.
function Notice({ status, notice }) {
  const { requests, activity, state, stopping } = status;
  const words = requests.map(({ role, verb, seconds, failure }) => {
    const asked = `${VERBS[verb][0]} ${ROLES[role]}`;
    if (failure) return `${asked}: ${failure}`;
    const when = activity?.role === role ? `; takes effect after ${activity.what}` : "";
    return `${asked}: requested${seconds > 1 ? ` ${duration(seconds)} ago` : ""}${when}`;
  });
  if (stopping && state !== "ended") words.push("The training ends after the rollouts under way.");
  const all = [notice, STATES[state]?.[2], ...words].filter(Boolean).join(" · ");
  return html`<p id="notice" class="notice" role="alert" hidden=${!all}>${all}</p>`;
}

// The result so far, how far the training is, and how fast.
function Result({ status, curve, controllers }) {
  const { mean, laws, references, checked, budget, axis, phase, seeds, paid } = curve;
  const { remaining, rounds, episodes } = status;
  const { none, lqt, adapted } = references; // of the closing evaluation: all on the same fields
  const evaluated = adapted !== undefined;
  const cost = adapted ?? (laws ? mean.at(-1) : null) ?? null;
  const said = [];
  if (evaluated && lqt) said.push(below(lqt, adapted, controllers.lqt));
  if (evaluated && none) said.push(`${((100 * adapted) / none).toPrecision(3)} % of the cost without control remains`);
  if (!evaluated && cost !== null) said.push("on the training's own fields; all controllers are compared at the end");
  if (!evaluated && cost === null && checked.lqt !== undefined) {
    said.push(`first check: ${text(checked.lqt)} with ${controllers.lqt}`);
    if (checked.none !== undefined) said.push(`${text(checked.none)} without control`);
  }
  const count = paid[0] === paid[1] ? paid[1] : `${paid[0]} to ${paid[1]}`;
  const rows = [
    ["phase", PHASES[phase] ?? phase],
    [axis, paid[1] && count, budget ? ` of ${budget}` : ""],
    ["time left", remaining !== null && duration(remaining)],
    ["seeds", seeds.length],
    ["rounds", text(rounds < 10 ? rounds : Math.round(rounds)), " 1/s"],
    ["episodes", text(episodes), " 1/s"],
  ];
  return html`
    <section id="result" class="panel result" aria-label="Result and progress">
      <div class="outcome">
        <p id="cost">
          ${cost === null ? "no cost of an adapted law yet" : html`<b>${text(cost)}</b> mean stage cost ${evaluated ? "of the adapted law" : "of the current law"}`}
        </p>
        <p id="share" class="muted">${said.join(" · ")}</p>
        ${evaluated && html`<${Costs} costs=${references} controllers=${controllers} />`}
      </div>
      <div class="advance">
        <progress id="progress" max=${budget || 1} value=${phase === "done" ? budget || 1 : budget ? Math.min(paid[0], budget) : 0} aria-label="rollouts of the budget"></progress>
        <dl id="figures" class="figures">
          ${rows.map(
            ([name, value, unit = ""]) => html`
              <div><dt>${name}</dt><dd><span>${value || "–"}</span><small>${unit}</small></dd></div>
            `,
          )}
        </dl>
      </div>
    </section>
  `;
}

// The costs as bars, from 0 to the largest.
function Costs({ costs, controllers }) {
  const known = COMPARED.filter((name) => Number.isFinite(costs[name]));
  const largest = Math.max(...known.map((name) => costs[name]));
  return html`
    <dl class="bars">
      ${known.map(
        (name) => html`
          <dt>${controllers[name]}</dt>
          <dd>
            <i style=${{ width: `${(80 * costs[name]) / largest}%`, background: `var(--${name}, var(--accent))` }}></i>
            ${text(costs[name])}
          </dd>
        `,
      )}
    </dl>
  `;
}

// By how much a cost is below another one.
function below(base, cost, name = "") {
  const share = 100 * (1 - cost / base);
  return `${Math.abs(share).toFixed(1)} % ${share >= 0 ? "below" : "above"} ${name}`.trim();
}

// Which component and pair is shown.
function Choices({ status, choose }) {
  const { components, component, place, panels } = status;
  const choice = (name, names, chosen, take) => html`
    <label hidden=${names.length < 2 || (name === "component" && panels.length > 1)}>
      ${name} <select id=${name} value=${chosen} onChange=${(event) => take(event.target.value)}>
        ${names.map((one) => html`<option value=${one}>${one}</option>`)}
      </select>
    </label>
  `;
  return [
    choice("component", components, components[component], (value) => {
      status.component = components.indexOf(value);
      choose({ component: status.component });
    }),
    choice("pair", place.namespaces ?? [], place.namespace, (value) => {
      place.namespace = value;
      choose({ namespace: value });
    }),
  ];
}

// What the closing evaluation gave, once it has been.
function Seeds({ curve, controllers }) {
  const { evaluations, references } = curve;
  const known = Object.entries(evaluations);
  if (!known.length) return null;
  const rows = known.length > 1 ? [...known, ["mean", references]] : known;
  return html`
    <section id="seeds-panel" class="panel seeds" aria-labelledby="seeds-title">
      <div class="head"><h2 id="seeds-title">Seeds: mean stage cost in the closing evaluation</h2></div>
      <div class="scroll">
        <table id="seeds">
          <tr>
            <th>seed</th>
            ${COMPARED.map((name) => html`<th>${controllers[name]}</th>`)}
            <th>against ${controllers.lqt}</th>
          </tr>
          ${rows.map(
            ([seed, costs]) => html`
              <tr>
                <td>${seed}</td>
                ${COMPARED.map((name) => html`<td>${text(costs[name])}</td>`)}
                <td>${below(costs.lqt, costs.adapted)}</td>
              </tr>
            `,
          )}
        </table>
      </div>
    </section>
  `;
}

function Nodes({ status }) {
  return html`
    <section id="nodes-panel" class="panel nodes" aria-labelledby="nodes-title">
      <div class="head"><h2 id="nodes-title">Nodes</h2></div>
      <div id="nodes" class="cards">
        ${status.nodes.map((node) => html`<${Card} ...${node} ended=${status.state === "ended"} />`)}
      </div>
    </section>
  `;
}

// One node: who it is, whether it is there, what it says of itself.
function Card({ role, name, present, level = 0, heard, restarts, rivals, message, values = [], ended }) {
  const lost = name && !ended ? "bad" : "muted";
  const facts = [present ? "present" : name ? "gone" : "not seen"];
  if (heard !== null) facts.push(heard < 1.5 ? "heard just now" : `last heard ${Math.round(heard)} s ago`);
  if (restarts) facts.push(restarts === 1 ? "joined again once" : `joined again ${restarts} times`);
  if (rivals) facts.push(`${rivals + 1} processes publish its topic`);
  return html`
    <article class="card" data-role=${role} data-present=${String(present)}>
      <h3>
        <span class="dot ${present ? (LEVELS[level] ?? "warn") : lost}"></span>
        <span>${role}</span><span class="muted">${name}</span>
      </h3>
      <p>${facts.join(", ")}</p>
      <p>${message}</p>
      <details hidden=${!values.length}>
        <summary>${values.length} values</summary>
        <dl>${values.map(([key, value]) => [html`<dt>${key}</dt>`, html`<dd>${value}</dd>`])}</dl>
      </details>
    </article>
  `;
}
