// Live view before a flight, an aid for focus and exposure: the camera's picture, its histogram, and how sharp its middle is.
import { again } from "./pictures.js";

const EVERY_MS = 400, AGAIN_MS = 2000, PATIENCE_MS = 3000, BINS = 64, CLIPPED = 250, CLOSER = 4;

export class Live {
  constructor(canvas) {
    Object.assign(this, { canvas, running: false, best: 0, closer: null });
    canvas.addEventListener("click", (event) => {
      const box = canvas.getBoundingClientRect();
      this.closer = this.closer ? null : [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
      this.best = 0;
    });
  }

  // Ask for pictures as long as `wanted()`. `shown(facts)` is told of each, `none(why)` where there is none.
  async run(wanted, shown, none) {
    if (this.running) return;
    this.running = true;
    this.best = 0;
    await again(EVERY_MS, wanted, async () => {
      try {
        const answer = await fetch("/api/live", { method: "POST", headers: { "content-type": "application/json" }, body: "{}", signal: AbortSignal.timeout(PATIENCE_MS) });
        if (answer.headers.get("content-type") === "image/jpeg") {
          const picture = await createImageBitmap(await answer.blob());
          if (wanted()) shown(this.draw(picture));
          return null;
        }
        const told = await answer.json();
        if (wanted()) none(told.error ?? told.text);
        return told.error ? AGAIN_MS : null;
      } catch {
        if (wanted()) none("The vehicle does not answer: no live view.");
        return AGAIN_MS;
      }
    });
    this.running = false;
  }

  draw(picture) {
    const { canvas } = this, { width, height } = picture, paper = canvas.getContext("2d", { willReadFrequently: true });
    Object.assign(canvas, { width, height });
    paper.drawImage(picture, 0, 0);
    const facts = measure(paper, width, height, this.closer ?? [0.5, 0.5]);
    this.best = Math.max(this.best, facts.sharpness);
    if (this.closer) {
      const [x, y] = this.closer.map((share) => Math.min(Math.max(share - 0.5 / CLOSER, 0), 1 - 1 / CLOSER));
      paper.drawImage(picture, x * width, y * height, width / CLOSER, height / CLOSER, 0, 0, width, height);
    }
    bars(paper, facts.histogram, width, height);
    return { aspect: width / height, sharpness: this.best ? facts.sharpness / this.best : 0, clipped: facts.clipped, closer: Boolean(this.closer) };
  }
}

// The shares of 64 levels of brightness, the share that is clipped in any colour, and how sharp the part around a place is:
// the mean square of the steps from pixel to pixel over that of the brightness.
function measure(paper, width, height, [across, down]) {
  const { data } = paper.getImageData(0, 0, width, height), grey = new Float32Array(width * height), histogram = new Array(BINS).fill(0);
  let clipped = 0;
  for (let at = 0; at < grey.length; at += 1) {
    const [red, green, blue] = [data[4 * at], data[4 * at + 1], data[4 * at + 2]];
    grey[at] = 0.299 * red + 0.587 * green + 0.114 * blue;
    histogram[Math.min(BINS - 1, Math.floor(grey[at] * BINS / 256))] += 1 / grey.length;
    if (Math.max(red, green, blue) >= CLIPPED) clipped += 1 / grey.length;
  }
  let steps = 0, light = 1e-9;
  const left = Math.floor(Math.min(Math.max(across - 1 / 6, 0), 2 / 3) * width), top = Math.floor(Math.min(Math.max(down - 1 / 6, 0), 2 / 3) * height);
  for (let y = top; y < top + Math.floor(height / 3) - 1; y += 1) for (let x = left; x < left + Math.floor(width / 3) - 1; x += 1) {
    const at = y * width + x;
    steps += (grey[at + 1] - grey[at]) ** 2 + (grey[at + width] - grey[at]) ** 2;
    light += grey[at] ** 2;
  }
  return { histogram, clipped, sharpness: steps / light };
}

function bars(paper, histogram, width, height) {
  const most = Math.max(...histogram.slice(1, -1), 1e-9), wide = width / 3, high = height / 6;
  paper.fillStyle = "rgb(0 0 0 / 60%)";
  paper.fillRect(width - wide, height - high, wide, high);
  histogram.forEach((share, bin) => {
    const bar = high * Math.min(1, share / most);
    paper.fillStyle = bin === BINS - 1 ? "#ff5a4f" : "#e9ebec";
    paper.fillRect(width - wide + bin * wide / BINS, height - bar, wide / BINS, bar);
  });
}
