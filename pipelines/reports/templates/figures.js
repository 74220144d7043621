// Draws the figures of a page with BokehJS: those near the viewport first, the others when there is time.
(() => {
  const root = document.documentElement;
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const color = name => getComputedStyle(root).getPropertyValue("--" + name).trim();
  const drawn = new Map();
  let figures, library;

  async function inflate(id) {
    const packed = Uint8Array.from(atob(document.getElementById(id).textContent), c => c.charCodeAt(0));
    return new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  }

  const load = () => library ??= (async () => {
    const [script, text] = await Promise.all(["bokeh", "figures"].map(inflate));
    figures = JSON.parse(text);
    const element = document.createElement("script");
    element.textContent = script;
    document.head.append(element);
    Bokeh.logger.set_level("warn");
  })();

  const mix = (a, b, t) => "#" + [1, 3, 5].map(k => {
    const [u, v] = [a, b].map(c => parseInt(c.slice(k, k + 2), 16));
    return Math.round(u + t * (v - u)).toString(16).padStart(2, "0");
  }).join("");
  const blend = (a, b, count) => Array.from({ length: count }, (_, i) => mix(a, b, i / (count - 1)));

  function add(figure, mark, spec) {
    const data = Object.fromEntries(Object.entries(mark.columns).map(([key, values]) => [key, values.map(v => v ?? NaN)]));
    const ink = color(mark.color);
    if (mark.texts.length) data.text = mark.texts;
    const line = { line_color: ink, line_width: mark.size, line_dash: mark.dash };
    const spans = (places, dimension) => places.map(location => {
      const span = new Bokeh.Span({ location, dimension, ...line });
      figure.add_layout(span);
      return span;
    });
    switch (mark.kind) {
      case "levels": return spans(data.y, "width");
      case "moments": return spans(data.x, "height");
      case "patches": {
        const split = values => values.reduce((all, v) => (isNaN(v) ? all.push([]) : all.at(-1).push(v), all), [[]]).slice(0, -1);
        data.x = split(data.x); data.y = split(data.y);
      }
    }
    const source = new Bokeh.ColumnDataSource({ data }), field = name => ({ field: name }), at = { x: field("x"), y: field("y"), source };
    const fill = { fill_color: ink, fill_alpha: mark.alpha };
    const words = { text: field("text"), text_align: "center", text_baseline: "middle", text_color: ink };
    const mapped = (palette, low, high) => ({ field: "value", transform: new Bokeh.LinearColorMapper({ palette, low, high }) });
    switch (mark.kind) {
      case "points":
        return [figure.scatter({ ...at, size: mark.size, marker: mark.shape == "ring" ? "circle" : mark.shape,
          ...(mark.shape == "circle" ? { ...fill, line_color: null } : { fill_color: null, line_color: ink, line_width: 1.5 }) })];
      case "line": return [figure.line({ ...at, ...line })];
      case "band": return [figure.varea({ x: field("x"), y1: field("low"), y2: field("high"), source, ...fill })];
      case "boxes":
        return [figure.quad({ left: field("left"), right: field("right"), bottom: field("low"), top: field("high"), source, ...fill, line_color: null })];
      case "segments": return [figure.segment({ x0: field("x"), y0: field("y"), x1: field("x1"), y1: field("y1"), source, line_color: ink })];
      case "text": return [figure.text({ ...at, ...words, text_font_size: "14px" })];
      case "heat": {
        const palette = [...blend(color("series0"), color("paper"), 25), ...blend(color("paper"), color("series2"), 25)];
        const tiles = figure.rect({ ...at, width: 1, height: 1, line_color: null, fill_color: mapped(palette, -1, 1) });
        return mark.texts.length ? [tiles, figure.text({ ...at, ...words, text_font_size: "11px" })] : [tiles];
      }
      case "patches": {
        // No darker than what is written on it can be read on.
        const palette = blend(mix(color("paper"), ink, 0.12), mix(color("paper"), ink, 0.45), 50);
        return [figure.patches({ xs: field("x"), ys: field("y"), source, line_color: color("soft"), fill_color: mapped(palette, 0, Math.max(...data.value)) })];
      }
    }
  }

  // What is told of a mark that is pointed at.
  const told = {
    points: [["x", "y"]], line: [["x", "y"]], boxes: [[null, "high"]], heat: [[null, "value"]], patches: [[null, "value"]],
  };

  function build(spec, before, wrapped, narrow) {
    const dates = spec.x_scale == "datetime";
    const range = limits => limits ? new Bokeh.Range1d({ start: limits[0], end: limits[1] }) : new Bokeh.DataRange1d();
    const zoom = new Bokeh.BoxZoomTool();
    const figure = Bokeh.Plotting.figure({
      height: spec.height, sizing_mode: "stretch_width", min_border_right: 12,
      x_axis_type: spec.x_scale, y_axis_type: spec.y_scale, x_axis_label: spec.x_title || null, y_axis_label: spec.y_title || null,
      x_range: range(spec.x_range), y_range: spec.y_shared ? new Bokeh.Range1d() : range(spec.y_range),
      match_aspect: spec.square, tools: [zoom, new Bokeh.PanTool(), new Bokeh.ResetTool(), new Bokeh.SaveTool()],
      active_drag: zoom, toolbar_location: "right",
      background_fill_color: null, border_fill_color: null, outline_line_color: color("grid"),
    });
    figure.toolbar.autohide = true;
    figure.toolbar.logo = null;
    for (const axis of figure.axes) {
      axis.axis_label_text_color = axis.major_label_text_color = color("soft");
      axis.axis_label_text_font_style = "normal";
      axis.axis_label_text_font_size = axis.major_label_text_font_size = "12px";
      axis.axis_line_color = axis.major_tick_line_color = color("grid");
      axis.minor_tick_line_color = null;
      if (narrow) axis.ticker.desired_num_ticks = 4;
      axis.visible = !spec.bare;
    }
    for (const grid of figure.grids) { grid.grid_line_color = color("grid"); grid.grid_line_alpha = 0.6; grid.visible = !spec.bare; }
    if (spec.bare) figure.outline_line_color = null;
    for (const [axis, grid, labels, turn] of [[figure.xaxes[0], figure.xgrids[0], spec.x_labels, 1.0], [figure.yaxes[0], figure.ygrids[0], spec.y_labels, 0]]) {
      if (!labels.length) continue;
      axis.ticker = new Bokeh.FixedTicker({ ticks: [...labels.keys()] });
      axis.major_label_overrides = new Map(labels.map((label, i) => [i, label]));
      if (turn && Math.max(...labels.map(label => label.length)) > 3) axis.major_label_orientation = turn;
      grid.visible = false;
    }
    if (spec.y_shared) {
      // Figures have documents of their own, so that they cannot have one range between them.
      const follow = () => figure.y_range.setv({ start: before.y_range.start, end: before.y_range.end });
      for (const end of ["start", "end"]) before.y_range.properties[end].change.connect(follow);
      follow();
      figure.yaxes[0].visible = wrapped;
    }
    const renderers = spec.marks.map(mark => {
      const made = add(figure, mark, spec);
      const [across, up] = (told[mark.kind] ?? [[]])[0];
      if (up || (mark.kind == "points" && mark.texts.length)) {
        const rows = mark.texts.length && mark.kind != "heat" ? [["", "@text"]] : [];
        if (across && !spec.bare && !spec.x_labels.length) rows.push([spec.x_title || "x", dates ? "@x{%F %R}" : "@x{%.6g}"]);
        if (!spec.bare) rows.push([mark.name || spec.y_title || "value", `@${up}{%.5g}`]);
        const formatters = { "@x": dates ? "datetime" : "printf", [`@${up}`]: "printf" };
        if (rows.length && !(spec.bare && !mark.texts.length)) figure.add_tools(new Bokeh.HoverTool({ renderers: [made[0]], tooltips: rows, formatters, visible: false }));
      }
      return made;
    });
    return { figure, renderers };
  }

  async function draw(place) {
    if (drawn.has(place)) return drawn.get(place);
    const job = (async () => {
      await load();
      const made = [];
      for (const [i, spec] of figures[place.dataset.figures].entries()) {
        const panel = place.querySelectorAll(".panel")[i], previous = panel.previousElementSibling;
        const built = build(spec, made.at(-1)?.figure, previous && panel.offsetTop > previous.offsetTop, panel.clientWidth < 400);
        made.push(built);
        panel.replaceChildren();
        await Bokeh.Plotting.show(built.figure, panel);
      }
      for (const button of place.querySelectorAll(".legend button")) button.onclick = () => {
        const shown = button.getAttribute("aria-pressed") != "true";
        button.setAttribute("aria-pressed", shown);
        figures[place.dataset.figures].forEach((spec, i) => spec.marks.forEach((mark, k) => {
          if (mark.name == button.textContent) for (const each of made[i].renderers[k]) each.visible = shown;
        }));
      };
      place.style.setProperty("--drawn-width", place.clientWidth);
      place.classList.toggle("on-dark", dark.matches);
      place.dataset.drawn = made.length;
    })();
    drawn.set(place, job);
    return job;
  }

  const places = [...document.querySelectorAll(".plot")];
  const near = new IntersectionObserver(seen => seen.forEach(each => each.isIntersecting && draw(each.target)), { rootMargin: "400px" });
  places.forEach(place => near.observe(place));
  const idle = window.requestIdleCallback ?? (job => setTimeout(job, 50));
  const rest = () => { const next = places.find(place => !drawn.has(place) && !place.closest("details:not([open])")); if (next) draw(next).then(() => idle(rest)); };
  addEventListener("load", () => idle(rest));
  document.addEventListener("toggle", () => idle(rest), true);
  addEventListener("beforeprint", () => {
    for (const fold of document.querySelectorAll("details")) fold.open = true;
    places.forEach(draw);
  });
  // --print-to-pdf prints once the page is loaded: a frame that is being written delays that until all is drawn.
  if (navigator.userAgent.includes("Headless")) {
    const frame = document.body.appendChild(document.createElement("iframe"));
    frame.hidden = true;
    frame.contentDocument.open();
    for (const fold of document.querySelectorAll("details")) fold.open = true;
    Promise.all(places.map(draw)).finally(() => frame.contentDocument.close());
  }
  dark.addEventListener("change", () => {
    // Not for a print in light colours, which the style sheet turns round.
    if (matchMedia("print").matches) return;
    drawn.clear();
    places.forEach(place => { near.unobserve(place); near.observe(place); });
    idle(rest);
  });
})();
