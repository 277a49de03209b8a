// Draws figures over time as charts, in place of their pictures: zoom, values under the cursor,
// events below the first, and the instant that the 3D view shows. The page holds the numbers in #charts.
"use strict";
(() => {
  const given = JSON.parse(document.getElementById("charts").textContent);
  const root = document.documentElement;
  const whole = given.end > 1e-9 ? [0, given.end] : [-0.5, 0.5];
  const charts = [];
  // Lines of each flight, and the borders of their markers in the legend.
  const looks = [
    { dash: [], border: "solid" },
    { dash: [9, 3, 2, 3], border: "dashed" },
    { dash: [2, 3], border: "dotted" },
    { dash: [12, 3, 2, 3, 2, 3], border: "double" },
  ];
  let span = whole;
  let now = 0;

  const colour = (name) => getComputedStyle(root).getPropertyValue(name).trim();
  const dark = () => colour("--dark") === "1";

  function numbers(text, Kind) {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    return Array.from(new Kind(bytes.buffer), (x) => (Number.isFinite(x) ? x : null));
  }

  // A dark colour is made lighter on a dark page.
  function tint(hex) {
    if (!dark()) return hex;
    const parts = [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));
    const light = (0.3 * parts[0] + 0.59 * parts[1] + 0.11 * parts[2]) / 255;
    const share = Math.max(0, 0.6 - light);
    return `rgb(${parts.map((part) => Math.round(part + (255 - part) * share)).join(",")})`;
  }

  const text = (value) =>
    value === null || value === undefined ? "–" : String(Number(value.toPrecision(5)));

  const raised = (power) => String(power).replace(/./g, (x) => "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"["-0123456789".indexOf(x)]);

  function make(tag, name, parent, content = "") {
    const made = document.createElement(tag);
    made.className = name;
    made.textContent = content;
    parent.append(made);
    return made;
  }

  function zoom(low, high) {
    span = [Math.max(low, whole[0]), Math.min(high, whole[1])];
    if (span[1] - span[0] < 1e-6) span = whole;
    charts.forEach((chart) => {
      chart.plot.setScale("x", { min: span[0], max: span[1] });
      chart.reset.hidden = span[0] <= whole[0] && span[1] >= whole[1];
      place(chart);
    });
  }

  // The hand of the instant that is shown, and the events below.
  function place({ plot, hand, lane, marks }) {
    const left = plot.over.offsetLeft;
    const width = plot.over.clientWidth;
    const at = (time) => ((time - span[0]) / (span[1] - span[0])) * width;
    hand.hidden = now < span[0] || now > span[1];
    hand.style.left = `${at(now)}px`;
    if (lane === null) return;
    lane.style.marginLeft = `${left}px`;
    lane.style.width = `${width}px`;
    // From the last to the first: a mark's words have the room up to the next.
    const limit = [width, width, width];
    // Those at the same place have no words beside these.
    const earlier = marks.map(({ event }, k) => Math.max(0, ...marks.slice(0, k)
      .filter((each) => each.event.row === event.row && at(each.event.time) < at(event.time) - 10)
      .map((each) => at(each.event.time) + 8)));
    for (let k = marks.length - 1; k >= 0; k--) {
      const { event, mark, words } = marks[k];
      const x = at(event.time);
      mark.hidden = event.time < span[0] - 1e-9 || event.time > span[1] + 1e-9;
      if (mark.hidden) continue;
      mark.style.left = `${x}px`;
      // The longest that fits of: the whole text, its first two details, the kind of the event.
      const [kind] = event.text.split(":");
      const texts = [event.text, (event.text.match(/^[^:]*: \S+ \S+/) ?? [kind])[0], kind];
      const [wide, , least] = texts.map((each) => 6.2 * each.length);
      let room = limit[event.row] - x - 14;
      const roomBefore = x - 14 - earlier[k];
      // At the right end, and where the next mark is near, the words stand before their mark.
      const before = room < (limit[event.row] === width ? wide : least) && roomBefore > room;
      if (before) room = roomBefore;
      // Of marks at one place a strong one has the words, or else the last.
      const outdone = marks.some((each, j) => j !== k && each.event.row === event.row &&
        Math.abs(at(each.event.time) - x) < 10 &&
        (each.event.strong === event.strong ? j > k : each.event.strong));
      mark.classList.toggle("before", before && !outdone);
      words.style.display = outdone || room < least ? "none" : "";
      words.textContent = texts.find((each) => 6.2 * each.length <= room) ?? kind;
      const start = before && !outdone ? x - 14 - 6.2 * words.textContent.length : x - 6;
      limit[event.row] = Math.min(limit[event.row], start);
    }
  }

  function range(chart) {
    return (plot, low, high) => {
      if (chart.rows) return [-0.15, chart.names.length];
      const all = plot.scales.x.min <= whole[0] && plot.scales.x.max >= whole[1];
      if (chart.window !== null && all) [low, high] = chart.window;
      else if (low === null) [low, high] = [0, 0];
      const near = [...chart.goals.map((goal) => goal[3]), ...chart.limits.map((each) => each[1])];
      if (all && !chart.log) {
        low = Math.min(low, ...near);
        high = Math.max(high, ...near);
      }
      if (chart.log) return [Math.floor(low), Math.max(Math.ceil(high), Math.floor(low) + 1)];
      const least = 1e-6 * Math.max(1, Math.abs(low), Math.abs(high));
      const room = high - low < least ? 0.05 : 0.06 * (high - low);
      return [low - room, high + room];
    };
  }

  // Goals, limits and the instants of faults, under the traces.
  function draw(chart) {
    return (plot) => {
      const { ctx, bbox } = plot;
      const line = (x0, y0, x1, y1, stroke, dashes) => {
        ctx.strokeStyle = stroke;
        ctx.setLineDash(dashes.map((x) => x * devicePixelRatio));
        ctx.beginPath();
        ctx.moveTo(x0, y0);
        ctx.lineTo(x1, y1);
        ctx.stroke();
      };
      const across = (time) => plot.valToPos(time, "x", true);
      const up = (value) => plot.valToPos(value, "y", true);
      ctx.save();
      ctx.beginPath();
      ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
      ctx.clip();
      ctx.lineWidth = 1.2 * devicePixelRatio;
      for (const [k, value] of chart.limits) {
        line(bbox.left, up(value), bbox.left + bbox.width, up(value), tint(chart.colours[k]), [1, 3]);
      }
      for (const [start, end, k, value] of chart.goals) {
        line(across(start), up(value), across(end), up(value), tint(chart.colours[k]), [7, 4]);
      }
      for (const event of given.events) {
        if (!event.strong) continue;
        const x = across(event.time);
        line(x, bbox.top, x, bbox.top + bbox.height, tint(event.colour), [2, 3]);
      }
      ctx.restore();
    };
  }

  function build(box, chart) {
    const alone = chart.own === 1;
    const height = () => {
      if (chart.rows) return 60 + 19 * chart.names.length;
      return box.clientWidth < 600 ? (alone ? 140 : 190) : alone ? 160 : 240;
    };
    const head = make("p", "chart-head", box, `${chart.label} (${chart.unit})`);
    if (chart.window !== null) make("small", "", head, " without short peaks; zoom in to see them");
    const reset = make("button", "reset", head, "show all");
    reset.type = "button";
    reset.hidden = true;
    reset.onclick = () => zoom(...whole);
    const look = (k) => looks[Math.floor(k / chart.own) % looks.length];
    const series = chart.names.map((name, k) => ({
      label: name,
      stroke: () => tint(chart.colours[k]),
      width: 1.4,
      dash: look(k).dash,
      spanGaps: false,
      points: { show: chart.time.length < 3 },
      value: (plot, value) =>
        text(value === null ? null
          : chart.rows ? (value - (chart.names.length - 1 - k)) / 0.8 : chart.log ? 10 ** value : value),
      ...(chart.rows && {
        paths: uPlot.paths.stepped({ align: -1 }),
        fill: () => tint(chart.colours[k]),
        fillTo: chart.names.length - 1 - k,
        width: 0.6,
      }),
    }));
    const axis = {
      stroke: () => colour("--ink"),
      grid: { stroke: () => colour("--line"), width: 1 },
      ticks: { stroke: () => colour("--line"), width: 1, size: 4 },
      font: "12px system-ui, sans-serif",
    };
    const rows = chart.names.map((name, k) => chart.names.length - 0.6 - k);
    const plot = new uPlot(
      {
        width: Math.max(box.clientWidth, 200),
        height: height(),
        scales: {
          x: { time: false, min: whole[0], max: whole[1] },
          y: { range: range(chart) },
        },
        axes: [
          { ...axis, size: 30, values: (_, ticks) => ticks.map((tick) => `${text(tick)} s`) },
          {
            ...axis,
            size: chart.rows ? 92 : 64,
            ...(chart.rows && {
              splits: rows,
              values: () => chart.names,
              grid: { show: false },
              font: "11px system-ui, sans-serif",
            }),
            ...(!chart.rows && {
              values: (_, ticks) =>
                ticks.map((tick) =>
                  chart.log ? (Number.isInteger(tick) ? `10${raised(tick)}` : "") : text(tick)),
            }),
            ...(chart.log && { incrs: [1, 2, 5, 10] }),
          },
        ],
        series: [{ label: "time", value: (_, time) => (time === null ? "–" : `${text(time)} s`) }, ...series],
        cursor: { sync: { key: "flight" }, drag: { x: true, y: false, setScale: false }, y: false },
        legend: {
          live: true,
          markers: { dash: (_, k) => look(Math.max(k - 1, 0)).border },
        },
        hooks: {
          drawAxes: [draw(chart)],
          setSelect: [
            (self) => {
              if (self.select.width < 3) return;
              zoom(self.posToVal(self.select.left, "x"),
                self.posToVal(self.select.left + self.select.width, "x"));
              self.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
            },
          ],
        },
      },
      [chart.time, ...chart.values],
      box,
    );
    const hand = make("div", "hand", plot.over);
    // Events stand once, below the first chart; all charts have the lines of the strong ones.
    const lane = charts.length === 0 && given.events.length > 0 ? make("div", "lane", box) : null;
    const marks = (lane === null ? [] : given.events).map((event) => {
      const mark = make("span", `mark row${event.row}`, lane);
      mark.title = `${text(event.time)} s: ${event.sentence}`;
      mark.dataset.kind = event.kind;
      mark.style.setProperty("--tint", event.colour);
      make("b", "", mark, event.glyph);
      return { event, mark, words: make("i", "", mark, event.text) };
    });
    const made = { plot, hand, lane, marks, reset };
    let pressed = null;
    plot.over.addEventListener("mousedown", (event) => { pressed = event.clientX; });
    plot.over.addEventListener("click", (event) => {
      if (pressed !== null && Math.abs(event.clientX - pressed) > 3) return;
      const time = plot.posToVal(event.clientX - plot.over.getBoundingClientRect().left, "x");
      document.dispatchEvent(new CustomEvent("flight:seek", { detail: time }));
    });
    plot.over.addEventListener("dblclick", () => zoom(...whole));
    new ResizeObserver(() => {
      const width = Math.max(box.clientWidth, 200);
      if (width !== plot.width) plot.setSize({ width, height: height() });
      place(made);
    }).observe(box);
    charts.push(made);
    place(made);
    requestAnimationFrame(() => place(made));
  }

  for (const chart of given.charts) {
    chart.time = numbers(chart.time, Float64Array);
    chart.values = chart.values.map((column) => numbers(column, Float32Array));
  }
  for (const figure of document.querySelectorAll("figure[data-charts]")) {
    const box = make("div", "charts", figure);
    figure.prepend(box);
    figure.classList.add("live");
    for (const number of figure.dataset.charts.split(" ")) {
      build(make("div", "chart", box), given.charts[Number(number)]);
    }
  }

  // Without the 3D view the charts show the instant themselves.
  function point(time) {
    now = Math.min(Math.max(time, whole[0]), whole[1]);
    charts.forEach(place);
  }
  document.addEventListener("flight:time", (event) => point(event.detail));
  document.addEventListener("flight:seek", (event) => point(event.detail));
  document.addEventListener("flight:theme", () => charts.forEach(({ plot }) => plot.redraw()));
  window.flightCharts = { charts, zoom, get span() { return span; }, get now() { return now; } };
})();
