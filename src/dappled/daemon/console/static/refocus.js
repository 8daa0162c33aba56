// The views of one frame as a texture, moved and averaged on the graphics card. The same sum is made in NumPy by
// dappled.daemon.console.pictures.refocused; a test compares the two.
const MOST_VIEWS = 32;   // along each axis
const VERTEX = `#version 300 es
void main() {
  vec2 corner = vec2(float((gl_VertexID << 1) & 2), float(gl_VertexID & 2));
  gl_Position = vec4(corner * 2.0 - 1.0, 0.0, 1.0);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D mosaic;
uniform vec2 tile;              // width, height of a view
uniform ivec2 views;            // columns, rows of views
uniform float rowSteps[${MOST_VIEWS}];     // how far a view moves for a disparity of 1
uniform float columnSteps[${MOST_VIEWS}];
uniform float disparity;        // in pixels of a tile, from view to view
out vec4 colour;
void main() {
  vec2 p = vec2(gl_FragCoord.x, tile.y - gl_FragCoord.y);
  vec2 whole = tile * vec2(views);
  float sum = 0.0, weight = 0.0;
  for (int v = 0; v < views.y; v++) for (int u = 0; u < views.x; u++) {
    vec2 q = p + disparity * vec2(columnSteps[u], rowSteps[v]);
    if (all(greaterThanEqual(q, vec2(0.499))) && all(lessThanEqual(q, tile - 0.499))) {
      sum += texture(mosaic, (vec2(u, v) * tile + clamp(q, vec2(0.5), tile - 0.5)) / whole).r;
      weight += 1.0;
    }
  }
  float linear = sum / max(weight, 1e-6);   // the texture is sRGB: it was made linear before it was interpolated
  float coded = linear <= 0.0031308 ? 12.92 * linear : 1.055 * pow(linear, 1.0 / 2.4) - 0.055;
  colour = vec4(vec3(coded), 1.0);
}`;

export class Refocus {
  // Raises an Error where there is no WebGL2.
  constructor(canvas) {
    this.canvas = canvas;
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("no WebGL2");
    this.gl = gl;
    this.program = link(gl);
    gl.useProgram(this.program);
    this.at = (name) => gl.getUniformLocation(this.program, name);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
    this.layout = null;
  }

  fits(layout) {
    const rows = layout.row_steps.length, columns = layout.column_steps.length, [height, width] = layout.tile;
    const most = this.gl.getParameter(this.gl.MAX_TEXTURE_SIZE);
    return Math.max(rows, columns) <= MOST_VIEWS && rows * height <= most && columns * width <= most;
  }

  show(layout, bitmap) {
    const gl = this.gl, [height, width] = layout.tile;
    gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.SRGB8_ALPHA8, gl.RGBA, gl.UNSIGNED_BYTE, bitmap);
    this.canvas.width = width;
    this.canvas.height = height;
    gl.viewport(0, 0, width, height);
    gl.uniform2f(this.at("tile"), width, height);
    gl.uniform2i(this.at("views"), layout.column_steps.length, layout.row_steps.length);
    gl.uniform1fv(this.at("rowSteps"), layout.row_steps);
    gl.uniform1fv(this.at("columnSteps"), layout.column_steps);
    this.layout = layout;
  }

  draw(disparity) {
    if (!this.layout) return;
    this.gl.uniform1f(this.at("disparity"), disparity / this.layout.scale);
    this.gl.drawArrays(this.gl.TRIANGLES, 0, 3);
  }
}

function link(gl) {
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error("the shader can't be linked");
  return program;
}

// The disparity at which all views agree best around a point (x, y in pixels of a tile): the least variance over views.
export function sharpest(layout, bitmap, x, y, reach = 3) {
  const { row_steps: down, column_steps: across, tile: [height, width] } = layout, radius = 9;
  const paper = new OffscreenCanvas(bitmap.width, bitmap.height);
  const pen = paper.getContext("2d", { willReadFrequently: true });
  pen.drawImage(bitmap, 0, 0);
  const pixels = pen.getImageData(0, 0, bitmap.width, bitmap.height).data, line = bitmap.width * 4;
  const value = (row, column, py, px) => {
    const cy = Math.min(Math.max(py, 0), height - 1.001), cx = Math.min(Math.max(px, 0), width - 1.001);
    const y0 = Math.floor(cy), x0 = Math.floor(cx), fy = cy - y0, fx = cx - x0;
    const at = (row * height + y0) * line + (column * width + x0) * 4;
    return (pixels[at] * (1 - fx) + pixels[at + 4] * fx) * (1 - fy) + (pixels[at + line] * (1 - fx) + pixels[at + line + 4] * fx) * fy;
  };
  let best = 0, least = Infinity;
  for (let disparity = -reach; disparity <= reach + 1e-9; disparity += 0.1) {
    const moved = disparity / layout.scale;
    let total = 0;
    for (let dy = -radius; dy <= radius; dy += 3) for (let dx = -radius; dx <= radius; dx += 3) {
      let sum = 0, squares = 0;
      for (let v = 0; v < down.length; v++) for (let u = 0; u < across.length; u++) {
        const one = value(v, u, y + dy + moved * down[v], x + dx + moved * across[u]);
        sum += one; squares += one * one;
      }
      total += squares - sum * sum / (down.length * across.length);
    }
    if (total < least) { least = total; best = disparity; }
  }
  return best;
}
