// Fetch the pictures of the page, three at a time. A browser has six connections to a host: Stop and Shoot find one free.
const AT_ONCE = 3;
const waiting = [];
let underWay = 0;

// What `read` makes of the answer, once a connection is free; null where it is no longer `wanted` by then. The picture
// on the stage goes `first`; of the others the newest does.
export function ask(url, { read = (answer) => answer.blob(), wanted = () => true, first = false } = {}) {
  return new Promise((resolve, reject) => {
    const one = { url, read, wanted, first, resolve, reject };
    if (first) waiting.push(one);
    else waiting.splice(waiting.findIndex((other) => other.first) >>> 0, 0, one);
    next();
  });
}

// Call `once` again and again as long as `wanted()`, but not while the page is hidden. It may tell how long to wait then,
// in place of `everyMs`.
export async function again(everyMs, wanted, once) {
  while (wanted()) {
    const wait = (document.hidden ? null : await once()) ?? everyMs;
    await new Promise((done) => setTimeout(done, wait));
  }
}

// An image for a canvas or the page; it stays empty where the vehicle has none.
export function image(url, loaded = () => {}, attributes = {}) {
  const picture = Object.assign(new Image(), attributes);
  ask(url).then((blob) => place(picture, blob)).then(loaded, () => {});
  return picture;
}

export function place(picture, blob) {
  const url = URL.createObjectURL(blob);
  return new Promise((resolve, reject) => {
    picture.onload = () => { URL.revokeObjectURL(url); resolve(picture); };
    picture.onerror = () => { URL.revokeObjectURL(url); reject(new Error("the picture can't be shown")); };
    picture.src = url;
  });
}

async function next() {
  if (underWay === AT_ONCE || !waiting.length) return;
  const one = waiting.pop();
  if (!one.wanted()) { one.resolve(null); next(); return; }
  underWay += 1;
  try {
    const answer = await fetch(one.url);
    if (!answer.ok) throw new Error(await refusal(answer));
    one.resolve(await one.read(answer));
  } catch (error) {
    one.reject(error);
  } finally {
    underWay -= 1;
    next();
  }
}

async function refusal(answer) {
  try { return (await answer.json()).error ?? `the vehicle answered ${answer.status}`; } catch { return `the vehicle answered ${answer.status}`; }
}
