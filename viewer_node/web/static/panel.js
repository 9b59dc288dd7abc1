// What is text on the page: title, state, figures, nodes, buttons.

import { duration, text } from "./format.js";

const STATES = {
  searching: ["", "looking for a training", "No training runs on this machine. Start one: pdeloop train burgers"],
  empty: ["warn", "no nodes", "Nobody publishes the loop's topics in this domain and namespace."],
  waiting: ["warn", "waiting for the first message", ""],
  running: ["good", "running", ""],
  silent: ["warn", "nothing heard", ""],
  paused: ["warn", "paused", ""],
  ended: ["", "ended", ""],
  recorded: ["", "over", ""],
};
const BUTTONS = [
  ["plant", "plant", [["pause", "Pause"], ["resume", "Resume"], ["step", "Step"]]],
  ["tuner", "training", [["pause", "Pause"], ["resume", "Resume"], ["stop", "Stop"]]],
];
const TITLES = {
  pause: "hold it where it is",
  resume: "go on",
  step: "one step, then pause again",
  stop: "end after this iteration",
};
const VERBS = { pause: "Pause", resume: "Resume", step: "Step", stop: "Stop" };
const DOING = { pause: "Pausing…", resume: "Resuming…", step: "Stepping…", stop: "Stopping…" };
const NAMES = {
  burgers: "Burgers",
  "allen-cahn": "Allen-Cahn",
  kdv: "Korteweg-de Vries",
  "kuramoto-sivashinsky": "Kuramoto-Sivashinsky",
  fisher: "Fisher-KPP",
  "cahn-hilliard": "Cahn-Hilliard",
  "ginzburg-landau": "Ginzburg-Landau",
  "convection-diffusion-reaction": "Convection-diffusion-reaction",
  wave: "Wave equation",
  schrodinger: "Schrödinger",
};
const WHAT = { plant: "plant", tuner: "training" };
const LEVELS = ["good", "warn", "bad", "warn"];
const SURE = 5000; // ms in which a second click confirms
const NOTICE = 10000; // ms for which a notice of the page's own stays

const find = (id) => document.getElementById(id);

function make(tag, words = "", className = "") {
  const made = document.createElement(tag);
  made.textContent = words;
  if (className) made.className = className;
  return made;
}

function put(element, words) {
  if (element.textContent !== words) element.textContent = words;
}

export class Panel {
  constructor(link) {
    this.link = link;
    this.buttons = new Map();
    this.told = { requests: [], activity: null, state: "", stopping: false, recorded: null };
    this.own = "";
    this.cards = {};
    for (const [role, name, verbs] of BUTTONS) this.group(role, name, verbs);
    this.choice("environment", (value) => ({ environment: Number(value) }));
    this.choice("component", (value) => ({ component: this.components.indexOf(value) }));
    this.choice("pair", (value) => ({ namespace: value }));
  }

  group(role, name, verbs) {
    const group = make("div", "", "group");
    group.append(make("span", name));
    for (const [verb, words] of verbs) {
      const button = make("button", words);
      button.id = `${role}-${verb}`;
      button.dataset.words = words;
      button.disabled = true;
      button.setAttribute("aria-label", `${words} ${name}: ${TITLES[verb]}`);
      button.addEventListener("click", () => this.click(button, role, verb, words));
      this.buttons.set(`${role}/${verb}`, button);
      group.append(button);
    }
    find("controls").append(group);
  }

  async click(button, role, verb, words) {
    if (verb === "stop" && !button.classList.contains("sure")) {
      button.classList.add("sure");
      button.textContent = "Really stop?";
      setTimeout(() => this.calm(button, words), SURE);
      return;
    }
    this.calm(button, words);
    button.disabled = true; // until the next status, which tells what came of it
    const answer = await this.link().post("/api/call", { node: button.dataset.node, verb });
    if (!answer.success) this.say(`${words} ${WHAT[role]}: ${answer.message}`);
  }

  calm(button, words) {
    button.classList.remove("sure");
    button.textContent = words;
  }

  choice(id, request) {
    find(id).addEventListener("change", (event) => this.request(request(event.target.value)));
  }

  // Ask for something else to be shown.
  async request(what) {
    const answer = await this.link().post("/api/watch", what);
    if (!answer.success) this.say(answer.message);
  }

  // A notice of the page itself, which goes by itself.
  say(words) {
    this.own = words;
    clearTimeout(this.forget);
    this.forget = setTimeout(() => this.say(""), words ? NOTICE : 2 ** 30);
    this.notice();
  }

  // What stands below the title is a function of the newest status, so that nothing old stays.
  notice() {
    const { requests, activity, state, stopping, recorded } = this.told;
    const words = requests.map(({ role, verb, seconds, failure }) => {
      const asked = `${VERBS[verb]} ${WHAT[role] ?? role}`;
      if (failure) return `${asked}: ${failure}`;
      const when = activity?.role === role ? `; takes effect after ${activity.what}` : "";
      return `${asked}: asked for${seconds > 1 ? ` ${duration(seconds)} ago` : ""}${when}`;
    });
    if (stopping && state !== "ended") words.push("The training ends after the rollouts under way.");
    const hint = STATES[state]?.[2];
    const all = [this.own, hint, recorded?.note, ...words].filter(Boolean).join(" · ");
    put(find("notice"), all);
    find("notice").hidden = !all;
  }

  connected(yes) {
    this.offline = !yes;
    if (yes) return;
    this.pill("bad", "no connection to the monitor");
    for (const button of this.buttons.values()) button.disabled = true;
  }

  pill(className, words) {
    find("state").className = `pill ${className}`;
    put(find("state"), words);
  }

  status(status, curve) {
    this.told = status;
    const { place, parameters, controls } = status;
    const [className, words] = Panel.doing(status);
    if (!this.offline) this.pill(className, words);
    this.notice();
    const problem = NAMES[parameters.problem] ?? parameters.problem ?? "pdeloop";
    put(find("problem"), problem);
    document.title = `${problem} – ${words} – pdeloop`;
    const where = [];
    if (place.folder) where.push(place.folder);
    if (place.domain !== null) where.push(`ROS domain ${place.domain}`);
    if (place.namespace && place.namespace !== "/") where.push(place.namespace);
    put(find("place"), where.join(" · "));
    this.figures(status, curve);
    this.nodes(status);
    for (const id of ["controls", "nodes-panel"]) find(id).hidden = Boolean(status.recorded);
    document.querySelector("main").classList.toggle("curve-only", status.recorded?.episodes === 0);
    for (const [key, button] of this.buttons) {
      const [role, verb] = key.split("/");
      const offer = controls.find((c) => c.role === role && c.verbs.includes(verb));
      const asked = status.requests.some((r) => r.role === role && r.verb === verb && !r.failure);
      const late = verb === "stop" && status.stopping;
      button.disabled = !offer || this.offline || asked || late;
      if (!button.classList.contains("sure")) put(button, asked || late ? DOING[verb] : button.dataset.words);
      button.dataset.node = offer ? offer.node : "";
      button.title = offer ? `${TITLES[verb]} (${offer.node}/${verb})` : `no ${role} offers the service ~/${verb}`;
    }
    this.options("environment", status.environments, status.environment);
    this.components = status.components;
    this.list("component", status.components, status.components[status.component]);
    find("component-label").hidden = status.components.length < 2;
    const pairs = place.namespaces ?? [];
    find("pair-label").hidden = pairs.length < 2;
    this.list("pair", pairs, place.namespace);
  }

  // Class and words of the state: what the nodes compute says more than that they are silent.
  static doing({ state, paused, activity, quiet, stopping, recorded }) {
    const [className, words] = STATES[state] ?? ["", state];
    if (recorded) return recorded.finished ? ["", "finished"] : ["warn", "not finished; nothing works on it"];
    if (state === "paused") return [className, `${paused.map((r) => WHAT[r] ?? r).join(" and ")} paused`];
    const busy = state === "running" || state === "silent" || state === "waiting";
    if (busy && activity) return ["good", `${activity.what}, ${duration(activity.seconds)}`];
    if (state === "silent") return [className, `${words} for ${duration(quiet ?? 0)}`];
    if (state === "running" && stopping) return [className, "stopping"];
    return [className, words];
  }

  options(id, count, chosen) {
    const most = Math.min(count, 4096);
    this.list(id, Array.from({ length: most }, (_, i) => String(i)), String(Math.min(chosen, most - 1)));
    find(`${id}-label`).hidden = count < 2;
  }

  list(id, names, chosen) {
    const select = find(id);
    const now = names.join("\n");
    if (select.dataset.names !== now) {
      select.dataset.names = now;
      select.replaceChildren(...names.map((name) => new Option(name, name)));
    }
    if (document.activeElement !== select && select.value !== chosen) select.value = chosen;
  }

  figures(status, curve) {
    const { mean, references, budget, axis, phase, seeds, paid } = curve.told;
    const closing = references.adapted; // what the closing evaluation gave counts, once it is there
    const cost = closing ?? (mean.length ? mean[mean.length - 1] : null);
    const rows = [["phase", phase || "–", ""]];
    const count = paid[0] === paid[1] ? paid[1] : `${paid[0]} to ${paid[1]}`;
    rows.push([axis, paid[1] ? String(count) : "–", budget ? ` of ${budget}` : ""]);
    if (!status.recorded) rows.push(["time left", status.remaining === null ? "–" : duration(status.remaining), ""]);
    rows.push([closing === undefined ? "cost now" : "evaluated cost", text(cost), ""]);
    const lqt = references.lqt;
    const share = lqt && cost !== null ? 100 * (1 - cost / lqt) : null;
    const side = share === null ? "" : share >= 0 ? " % below" : " % above";
    rows.push(["against LQT", share === null ? "–" : Math.abs(share).toFixed(1), side]);
    rows.push(["seeds", seeds.length ? String(seeds.length) : "–", ""]);
    if (!status.recorded) rows.push(["rounds", text(status.rounds < 10 ? status.rounds : Math.round(status.rounds)), " 1/s"]);
    if (!status.recorded) rows.push(["episodes", text(status.episodes), " 1/s"]);
    else rows.push(["recorded episodes", String(status.recorded.episodes), ""]);
    const list = find("figures");
    if (list.children.length !== rows.length) {
      list.replaceChildren(
        ...rows.map(() => {
          const row = make("div");
          const value = make("dd");
          value.append(make("span"), make("small"));
          row.append(make("dt"), value);
          return row;
        }),
      );
    }
    rows.forEach(([name, value, unit], i) => {
      const row = list.children[i];
      put(row.firstChild, name);
      put(row.lastChild.firstChild, value);
      put(row.lastChild.lastChild, unit);
    });
  }

  // What the closing evaluation gave, once it has been.
  seeds({ evaluations, references }, controllers) {
    const known = Object.entries(evaluations);
    find("seeds-panel").hidden = !known.length;
    if (!known.length) return;
    const names = ["none", "lqt", "adapted"];
    const below = ({ lqt, adapted }) => `${text(Number((100 * (1 - adapted / lqt)).toFixed(1)))} %`;
    const row = (cells, tag) => {
      const made = make("tr");
      made.append(...cells.map((words) => make(tag, words)));
      return made;
    };
    const line = (name, costs) => [name, ...names.map((n) => text(costs[n])), below(costs)];
    const head = ["seed", ...names.map((n) => controllers[n] ?? n), `below ${controllers.lqt ?? "LQT"}`];
    find("seeds").replaceChildren(
      row(head, "th"),
      ...known.map(([seed, costs]) => row(line(seed, costs), "td")),
      ...(known.length > 1 ? [row(line("mean", references), "td")] : []),
    );
  }

  nodes(status) {
    const all = find("nodes");
    for (const node of status.nodes) {
      this.cards[node.role] ??= new Card(all, node.role);
      this.cards[node.role].show(node, status.state === "ended");
    }
  }
}

// One node: who it is, whether it is there, what it says of itself.
class Card {
  constructor(all, role) {
    this.card = make("article", "", "card");
    this.card.dataset.role = role;
    this.dot = make("span", "", "dot");
    this.name = make("span", "", "muted");
    this.facts = make("p");
    this.message = make("p");
    this.details = make("details");
    this.summary = make("summary");
    this.list = make("dl");
    const title = make("h3");
    title.append(this.dot, make("span", role), this.name);
    this.details.append(this.summary, this.list);
    this.card.append(title, this.facts, this.message, this.details);
    all.append(this.card);
  }

  show(node, ended) {
    const lost = node.name && !ended ? "bad" : "muted";
    const level = node.present ? (LEVELS[node.level ?? 0] ?? "warn") : lost;
    this.card.dataset.present = String(node.present);
    this.dot.className = `dot ${level}`;
    put(this.name, node.name);
    put(this.facts, Card.facts(node));
    put(this.message, node.message ?? "");
    const values = node.values ?? [];
    this.details.hidden = !values.length;
    put(this.summary, `${values.length} values`);
    if (this.list.children.length !== 2 * values.length) {
      this.list.replaceChildren(...values.flatMap(() => [make("dt"), make("dd")]));
    }
    values.flat().forEach((words, i) => put(this.list.children[i], words));
  }

  static facts(node) {
    const facts = [node.present ? "there" : node.name ? "gone" : "not seen"];
    if (node.heard !== null) {
      const ago = Math.round(node.heard);
      facts.push(node.heard < 1.5 ? "heard now" : `last heard ${ago} s ago`);
    }
    if (node.restarts) facts.push(node.restarts === 1 ? "joined again once" : `joined again ${node.restarts} times`);
    if (node.rivals) facts.push(`${node.rivals + 1} processes publish its topic`);
    return facts.join(", ");
  }
}
