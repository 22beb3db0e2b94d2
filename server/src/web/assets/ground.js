// The ground as a picture: hillshade with contours, or semantic colours with the same shade.

const HOLE = 65535;
const STEPS = [0.1, 0.2, 0.25, 0.5, 1, 2, 2.5, 5, 10, 20, 50, 100];

export class Ground {
  // The map with this hash; empty until `load` is done.
  constructor(id, hash) {
    Object.assign(this, { id, hash, about: null, heights: null, colours: null, pictures: new Map() });
  }

  async load() {
    const path = `/live/map/${encodeURIComponent(this.id)}`;
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
    this.contour_m = STEPS.find((step) => (high - low) / step <= 12) ?? 200;
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
    const line = dark ? 1.28 : 0.86;
    for (let row = 0; row < rows; row++) {
      for (let column = 0; column < columns; column++) {
        const cell = row * columns + column, pixel = 4 * ((rows - 1 - row) * columns + column), h = z[cell];
        if (Number.isNaN(h)) continue;
        const around = this.around(row, column), [east, , north] = around;
        const light = Math.min(Math.max(0.58 + 0.6 * this.shade(around), 0.4), 1.2);
        const level = Math.floor(h / this.contour_m);
        const contour = layer === "elevation" && (Math.floor(east / this.contour_m) !== level || Math.floor(north / this.contour_m) !== level) ? line : 1;
        const share = (h - low) / (high - low || 1);
        for (let c = 0; c < 3; c++) {
          const base = layer === "semantics" ? this.colours[3 * cell + c] * (dark ? 0.55 : 0.72) + (dark ? 8 : 66) : from[c] + share * (to[c] - from[c]);
          image.data[pixel + c] = base * light * contour;
        }
        image.data[pixel + 3] = 255;
      }
    }
    context.putImageData(image, 0, 0);
    return canvas;
  }
}
