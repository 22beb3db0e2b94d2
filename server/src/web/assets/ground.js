// The ground as a picture: hillshade, or semantic colours with the same shade; lines of equal height apart from it, as sharp as the screen.

const HOLE = 65535;
const STEPS = [0.1, 0.2, 0.25, 0.5, 1, 2, 2.5, 5, 10, 20, 50, 100];

// A semantic colour as it is painted: less lively than what is drawn on it.
export const painted = (value, dark) => Math.round(value * (dark ? 0.55 : 0.72) + (dark ? 8 : 66));

export class Ground {
  // The map with this hash; empty until `load` is done.
  constructor(id, hash) {
    Object.assign(this, { id, hash, about: null, heights: null, colours: null, pictures: new Map() });
  }

  async load() {
    const path = `live/map/${encodeURIComponent(this.id)}`;
    const get = async (url) => {
      const answer = await fetch(url);
      if (!answer.ok) throw new Error(await answer.text());
      return answer;
    };
    const about = await (await get(path)).json();
    const raw = new DataView(await (await get(`${path}/elevation`)).arrayBuffer());
    const [low, high] = about.height_range_m;
    this.heights = Float32Array.from({ length: about.columns * about.rows }, (_, i) => {
      const share = raw.getUint16(2 * i, true);
      return share === HOLE ? NaN : low + ((high - low) * share) / (HOLE - 1);
    });
    if (about.semantics) this.colours = new Uint8Array(await (await get(`${path}/semantics`)).arrayBuffer());
    this.contour_m = STEPS.find((step) => (high - low) / step <= 12) ?? (high - low) / 12;
    this.about = about;
  }

  get extent() {
    const { origin_m: [x, y], resolution_m: r, columns, rows } = this.about;
    return { x, y, width: (columns - 1) * r, height: (rows - 1) * r };
  }

  height(x, y) {
    const { origin_m, resolution_m, columns, rows } = this.about;
    const column = Math.round((x - origin_m[0]) / resolution_m), row = Math.round((y - origin_m[1]) / resolution_m);
    return column < 0 || row < 0 || column >= columns || row >= rows ? NaN : this.heights[row * columns + column];
  }

  className(x, y) {
    if (!this.colours) return null;
    const { origin_m, resolution_m, columns, rows, classes } = this.about;
    const column = Math.round((x - origin_m[0]) / resolution_m), row = Math.round((y - origin_m[1]) / resolution_m);
    if (column < 0 || row < 0 || column >= columns || row >= rows) return null;
    const at = 3 * (row * columns + column), rgb = this.colours.subarray(at, at + 3);
    return classes.find((c) => c.colour && c.colour.every((v, i) => v === rgb[i]))?.name ?? null;
  }

  // Heights of the cells to the east, west, north and south; at the edge and beside a hole that of the cell itself.
  around(row, column) {
    const { columns, rows } = this.about, z = this.heights, own = z[row * columns + column];
    const at = (r, c) => {
      const h = r < 0 || c < 0 || r >= rows || c >= columns ? NaN : z[r * columns + c];
      return Number.isNaN(h) ? own : h;
    };
    return [at(row, column + 1), at(row, column - 1), at(row + 1, column), at(row - 1, column)];
  }

  // Light from the north-west, 45 degrees high; slopes of open country are exaggerated to be seen.
  shade([east, west, north, south]) {
    const gain = 1.6 / (2 * this.about.resolution_m), dx = (east - west) * gain, dy = (north - south) * gain;
    return (0.5 * dx - 0.5 * dy + 0.7071) / Math.hypot(dx, dy, 1);
  }

  // Lines of equal height between two corners of what is seen, as pieces of four numbers, x and y of both ends. Looks at every so many cells.
  contours([x0, y0], [x1, y1], every) {
    const { origin_m: [x, y], resolution_m: r, columns, rows } = this.about, { heights: z, contour_m: step } = this, pieces = [];
    const first = (seen, start) => Math.max(Math.floor((seen - start) / r / every), 0) * every;
    for (let row = first(y0, y); row + every < rows && y + row * r < y1; row += every) {
      for (let column = first(x0, x); column + every < columns && x + column * r < x1; column += every) {
        const at = row * columns + column, up = every * columns, around = [z[at], z[at + every], z[at + up + every], z[at + up]];
        const high = Math.max(...around);
        for (let n = Math.ceil(Math.min(...around) / step); n * step < high; n++) {
          for (let i = 0; i < 4; i++) {
            // Counter-clockwise from the south-west; of four crossings each two that follow are joined.
            const [from, to] = [around[i], around[(i + 1) % 4]], share = (n * step - from) / (to - from);
            if (from < n * step === to < n * step) continue;
            pieces.push(x + r * (column + every * [share, 1, 1 - share, 0][i]), y + r * (row + every * [0, share, 1, 1 - share][i]));
          }
        }
      }
    }
    return pieces;
  }

  picture(layer, dark) {
    const key = `${layer}${dark}`;
    if (!this.pictures.has(key)) this.pictures.set(key, this.paint(layer === "semantics" && this.colours ? "semantics" : "elevation", dark));
    return this.pictures.get(key);
  }

  paint(layer, dark) {
    const { columns, rows, height_range_m: [low, high] } = this.about;
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [columns, rows];
    const context = canvas.getContext("2d"), image = context.createImageData(columns, rows), z = this.heights;
    const [from, to] = dark ? [[31, 39, 44], [72, 77, 74]] : [[203, 211, 207], [243, 240, 229]];
    for (let row = 0; row < rows; row++) {
      for (let column = 0; column < columns; column++) {
        const cell = row * columns + column, pixel = 4 * ((rows - 1 - row) * columns + column), h = z[cell];
        if (Number.isNaN(h)) continue;
        const light = Math.min(Math.max(0.58 + 0.6 * this.shade(this.around(row, column)), 0.4), 1.2);
        const share = (h - low) / (high - low || 1);
        for (let c = 0; c < 3; c++) {
          const base = layer === "semantics" ? painted(this.colours[3 * cell + c], dark) : from[c] + share * (to[c] - from[c]);
          image.data[pixel + c] = base * light;
        }
        image.data[pixel + 3] = 255;
      }
    }
    context.putImageData(image, 0, 0);
    return canvas;
  }
}
