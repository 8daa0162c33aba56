// The settings of body and decoder that MAVLink can set: one choice each; what can only be read is text.
import { element } from "./format.js";

const PATIENCE_MS = 6000;   // a body takes up to five seconds
const ENDS_FLIGHT = ["LF_MASK", "LF_LAW"];

export class Settings {
  // `set(name, value)` sends a change; `tell(text, state)` shows a sentence.
  constructor(list, set, tell) {
    Object.assign(this, { list, set, tell, shown: new Map(), asked: null, enabled: false });
  }

  show(settings) {
    if (settings.map((one) => one.name).join() !== [...this.shown.keys()].join()) this.build(settings);
    for (const one of settings) this.update(one);
    this.settle(settings);
  }

  build(settings) {
    this.shown.clear();
    this.list.replaceChildren(...settings.map(({ name, title }) => {
      const select = element("select", { id: `set-${name}`, disabled: "" }), text = element("span", { class: "fixed" });
      select.addEventListener("change", () => this.change(name, title, select));
      this.shown.set(name, { select, text, choices: "" });
      return element("label", { for: `set-${name}` }, element("span", {}, title), select, text);
    }));
  }

  update({ name, value, choices }) {
    const one = this.shown.get(name), known = [...new Set(choices.includes(value) || !choices.length ? choices : [value, ...choices])];
    if (one.choices !== known.join("\n")) {
      one.choices = known.join("\n");
      one.select.replaceChildren(...known.map((choice) => element("option", { value: choice }, choice)));
    }
    one.select.hidden = !choices.length;
    one.text.hidden = Boolean(choices.length);
    one.text.textContent = value || "unknown";
    one.value = value;
    if (this.asked?.name !== name && one.select.value !== value) one.select.value = value;
  }

  enable(able) {
    this.enabled = able;
    for (const { select } of this.shown.values()) select.disabled = !able;
  }

  async change(name, title, select) {
    const { value: before } = this.shown.get(name), value = select.value;
    if (ENDS_FLIGHT.includes(name) && !confirm(`${title} ${value} ends this flight and begins the next one. Go on?`)) {
      select.value = before;
      return;
    }
    this.asked = { name, title, value, until: performance.now() + PATIENCE_MS };
    if (!(await this.set(name, value))) this.asked = null;
  }

  // How a change ended that was asked for: only what the body reports counts.
  settle(settings) {
    if (!this.asked) return;
    const { name, title, value, until } = this.asked, now = settings.find((one) => one.name === name)?.value;
    if (now !== value && performance.now() < until) return;
    this.asked = null;
    if (now === value) this.tell(`${title} is ${value}`);
    else this.tell(`${title} stays ${now || "unknown"}: the camera has not taken ${value}`, "bad");
    this.shown.get(name).select.value = now;
  }
}
