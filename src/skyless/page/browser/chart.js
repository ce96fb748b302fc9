/** Charts over time: uPlot in the page's colours. */

import uPlot from "./vendor/uplot/uPlot.esm.js";
import { on, state } from "./store.js";
import { h, text } from "./dom.js";
import { palette } from "./theme.js";
import { DASH } from "./format.js";

/** @type {Set<Chart>} */
const charts = new Set();
on(["theme"], () => charts.forEach((chart) => chart.rebuild()));

const HEIGHT = 96;

export class Chart {
  /**
   * @param {string} title the quantity, with its unit
   * @param {Array<{name: string, colour: string, steps?: boolean}>} series colours are names of the palette
   * @param {(value: number) => string} write formats values
   * @param {number} span minimum of y's range
   * @param {{zero?: boolean, whole?: boolean}} options whether y starts at zero, and whether its marks are whole numbers
   */
  constructor(title, series, write, span, { zero = true, whole = false } = {}) {
    this.series = series;
    this.write = write;
    this.axis = { span, zero, whole };
    this.plot = null;
    this.data = [[], ...series.map(() => [])];
    this.value = h("output", {});
    this.box = h("div", { class: "chart-box", role: "img", "aria-label": title });
    this.element = h("figure", { class: "chart" }, h("figcaption", {}, h("span", {}, title), this.value), this.box);
    this.window = [0, 60];
    new ResizeObserver(() => this.resize()).observe(this.box);
    charts.add(this);
  }

  /** Show values against seconds before now (≤ 0); the last one also as a figure, unless it is old. */
  show(data, window_s) {
    this.data = data;
    this.window = [-window_s, 0];
    const isNow = (value, index) => value !== null && !Number.isNaN(value) && data[0][index] > -state.thresholds.report_s;
    const last = data.slice(1).map((values) => values.findLast(isNow));
    const parts = last.map((value) => (value === undefined ? DASH : this.write(value)));
    const words =
      this.series.length > 1 ? parts.map((part, n) => `${this.series[n].name} ${part}`).join("  ") : parts[0];
    text(this.value, words);
    if (!this.plot && this.box.clientWidth) this.build();
    this.plot?.setData(data);
  }

  resize() {
    if (!this.box.clientWidth) return;
    if (!this.plot) this.build();
    else this.plot.setSize({ width: this.box.clientWidth, height: HEIGHT });
  }

  rebuild() {
    if (!this.plot) return;
    this.plot.destroy();
    this.plot = null;
    if (this.box.clientWidth) this.build();
  }

  build() {
    this.plot = new uPlot(this.settings(), this.data, this.box);
  }

  /** Label of a mark on the axis, without trailing zeros. */
  tick(value) {
    return this.write(value).replace(/[.]0+(?=\D|$)/, "");
  }

  settings() {
    const axis = {
      stroke: palette.muted,
      grid: { stroke: palette.grid, width: 1 },
      ticks: { show: false },
      font: "10px system-ui, sans-serif",
    };
    const { span, zero, whole } = this.axis;
    const range = (_plot, low, high) => {
      if (low === null || high === null || low === undefined) return [0, span];
      const bottom = zero ? 0 : low;
      const spare = Math.max(span - (high - bottom), 0.12 * (high - bottom), 1e-9);
      return [zero ? 0 : bottom - spare / 2, high + spare / (zero ? 1 : 2)];
    };
    return {
      width: this.box.clientWidth,
      height: HEIGHT,
      pxAlign: false,
      legend: { show: false },
      cursor: { show: false },
      padding: [6, 14, 0, 0],
      scales: { x: { time: false, range: () => this.window }, y: { range } },
      axes: [
        {
          ...axis,
          size: 20,
          gap: 6,
          values: (_plot, marks) => marks.map((mark) => `${mark || "now"}`.replace("-", "−")),
        },
        {
          ...axis,
          size: 48,
          gap: 4,
          space: 26,
          incrs: whole ? [1, 2, 5, 10, 20, 50, 100, 200, 500] : undefined,
          values: (_plot, marks) => marks.map((mark) => this.tick(mark)),
        },
      ],
      series: [
        {},
        ...this.series.map(({ colour, steps }) => ({
          stroke: palette[colour],
          width: 1.5,
          spanGaps: false,
          points: { show: false },
          paths: steps ? uPlot.paths.stepped({ align: 1 }) : undefined,
        })),
      ],
    };
  }
}
