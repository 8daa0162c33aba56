// The settings of body and decoder that MAVLink can set: a choice, and a button that sets it. What can only be read is text.
import { element } from "./format.js";

const PATIENCE_MS = 6000;   // a body takes up to five seconds
const ENDS_FLIGHT = ["LF_MASK", "LF_LAW"];

export class Settings {
  // `set(name, value)` sends a change, and says whether it may have been taken; `tell(text, state)` shows a sentence.
  constructor(list, set, tell) {
    Object.assign(this, { list, set, tell, shown: new Map(), asked: new Map(), enabled: false });
  }

  show(settings) {
    if (settings.map((one) => one.name).join() !== [...this.shown.keys()].join()) this.build(settings);
    for (const one of settings) this.update(one);
    for (const one of settings) this.settle(one);
  }

  build(settings) {
    this.shown.clear();
    this.list.replaceChildren(...settings.map(({ name, title }) => {
      const select = element("select", { id: `set-${name}`, disabled: "" }), text = element("span", { class: "fixed" });
      const button = element("button", { type: "button", hidden: "", "data-set": name }, ENDS_FLIGHT.includes(name) ? "End the flight, set" : "Set");
      select.addEventListener("change", () => { button.hidden = select.value === this.shown.get(name).value; });
      button.addEventListener("click", () => this.change(name, title));
      this.shown.set(name, { select, text, button, choices: "" });
      return element("div", { class: "setting" }, element("label", { for: `set-${name}` }, title), select, text, button);
    }));
    this.enable(this.enabled);
  }

  update({ name, value, choices }) {
    const one = this.shown.get(name), known = [...new Set(choices.includes(value) || !choices.length ? choices : [value, ...choices])];
    if (one.choices !== known.join("\n")) {
      one.choices = known.join("\n");
      one.select.replaceChildren(...known.map((choice) => element("option", { value: choice }, choice)));
      one.button.hidden = true;
    }
    one.select.hidden = !choices.length;
    one.text.hidden = Boolean(choices.length);
    one.text.textContent = value || "unknown";
    one.value = value;
    if (one.button.hidden && !this.asked.has(name) && one.select.value !== value) one.select.value = value;
  }

  enable(able) {
    this.enabled = able;
    for (const { select, button } of this.shown.values()) select.disabled = button.disabled = !able;
  }

  async change(name, title) {
    const one = this.shown.get(name), value = one.select.value;
    one.button.hidden = true;
    this.asked.set(name, { title, value, until: performance.now() + PATIENCE_MS });
    if (!(await this.set(name, value))) this.asked.delete(name);
  }

  // How a change ended that was asked for: only what the body reports counts.
  settle({ name, value: now }) {
    const asked = this.asked.get(name);
    if (!asked || (now !== asked.value && performance.now() < asked.until)) return;
    this.asked.delete(name);
    if (now === asked.value) this.tell(`${asked.title} is ${now}`);
    else this.tell(`${asked.title} stays ${now || "unknown"}: the camera has not taken ${asked.value}`, "bad");
    this.shown.get(name).select.value = now;
  }
}
