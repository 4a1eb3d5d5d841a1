"use strict";
(() => {
  const of = (id) => document.getElementById(id);
  const { columns, cameras, width, height, margin } = JSON.parse(of("described").textContent);
  const [left, top, right, bottom] = margin;
  const namespace = document.querySelector(".charts svg").namespaceURI;
  const made = (name, attributes, text) => {
    const svg = ["svg", "g", "rect", "path", "text"].includes(name);
    const element = svg ? document.createElementNS(namespace, name) : document.createElement(name);
    Object.entries(attributes || {}).forEach(([key, value]) => element.setAttribute(key, value));
    if (text !== undefined) element.textContent = text;
    return element;
  };
  const floats = (text) => {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const view = new DataView(bytes.buffer);
    return Float32Array.from({ length: bytes.length / 4 }, (_, i) => view.getFloat32(4 * i, true));
  };
  const short = (value) => (value === 0 || (Math.abs(value) >= 1e-3 && Math.abs(value) < 1e5) ? String(+value.toPrecision(4)) : value.toExponential(2));
  const bounds = (values) => {
    const known = [...values].filter(Number.isFinite);
    return known.length ? [known.reduce((a, b) => Math.min(a, b)), known.reduce((a, b) => Math.max(a, b))] : [0, 1];
  };
  // one dimension's course, as `actrm-data plot` draws it
  const chart = (title, values, [low, high], stride, length) => {
    const size = [left + width + right, top + height + bottom];
    const svg = made("svg", { viewBox: `0 0 ${size[0]} ${size[1]}`, width: size[0], height: size[1], role: "img", "aria-label": title });
    const group = made("g", { transform: `translate(${left},${top})` });
    const x = (i) => (i * stride * width) / Math.max(length - 1, 1);
    const y = (v) => (high > low ? height - ((v - low) / (high - low)) * height : height / 2);
    let path = "", down = false;
    values.forEach((value, i) => {
      const good = Number.isFinite(value);
      if (good) path += `${down ? "L" : "M"}${x(i).toFixed(1)},${y(value).toFixed(1)}`;
      down = good;
    });
    group.append(
      made("text", { x: 0, y: -8, class: "title" }, title),
      made("rect", { width, height, class: "frame" }),
      made("path", { d: path, class: "line" }),
      made("text", { x: -4, y: 9, "text-anchor": "end" }, short(high)),
      made("text", { x: -4, y: height, "text-anchor": "end" }, short(low)),
      made("text", { x: 0, y: height + 14 }, "0"),
      made("text", { x: width, y: height + 14, "text-anchor": "end" }, String(length - 1)),
    );
    svg.append(group);
    return svg;
  };
  const curves = (column, values, stride, length) => {
    const dim = column.names.length;
    const drawn = made("div", { class: "curves" });
    column.names.forEach((name, d) => {
      const mine = values.filter((_, i) => i % dim === d);
      const range = of("own").checked ? null : column.range;
      drawn.append(chart(dim > 1 ? `${column.name}: ${name}` : column.name, mine, range || bounds(mine), stride, length));
    });
    return drawn;
  };
  const draw = (episode) => {
    const data = of(`data-${episode.id.slice(8)}`);
    if (!data || episode.dataset.drawn) return;
    episode.dataset.drawn = "yes";
    const { stride, curves: all, frames, pictures } = JSON.parse(data.textContent);
    const length = +episode.dataset.length;
    episode.querySelector(".wait").remove();
    pictures.forEach((files, camera) => {
      episode.append(made("h3", {}, cameras[camera]));
      const row = made("div", { class: "frames", tabindex: 0, role: "region", "aria-label": cameras[camera] });
      files.forEach((file, i) => {
        const figure = made("figure");
        const alt = `${cameras[camera]}, step ${frames[i]}`;
        figure.append(made("img", { src: `data:image/png;base64,${file}`, alt }), made("figcaption", {}, `step ${frames[i]}`));
        row.append(figure);
      });
      episode.append(row);
    });
    if (stride > 1) episode.append(made("p", { class: "wait" }, `Every ${stride}th of ${length} steps is drawn.`));
    columns.forEach((column, at) => {
      const values = floats(all[at]);
      if (!values.length) return;
      const details = made("details");
      details.append(made("summary", {}, `${column.name} (${column.names.length})`));
      const show = () => details.open && details.children.length < 2 && details.append(curves(column, values, stride, length));
      details.addEventListener("toggle", show);
      of("own").addEventListener("change", () => {
        details.querySelectorAll(".curves").forEach((drawn) => drawn.remove());
        show();
      });
      details.open = at === 0;
      show();
      episode.append(details);
    });
  };
  const list = of("episodes");
  const episodes = [...list.children];
  list.addEventListener("toggle", (event) => {
    if (event.target.classList.contains("episode") && event.target.open) draw(event.target);
  }, true);
  const apply = () => {
    const wanted = of("find").value.trim().toLowerCase();
    let count = 0;
    episodes.forEach((episode) => {
      episode.hidden = !episode.firstElementChild.textContent.toLowerCase().includes(wanted);
      count += episode.hidden ? 0 : 1;
    });
    of("shown").textContent = wanted ? `${count} of ${episodes.length} episodes` : `${episodes.length} episodes`;
  };
  of("find").addEventListener("input", apply);
  of("find").form.addEventListener("submit", (event) => event.preventDefault());
  of("order").addEventListener("change", (event) => {
    const by = event.target.value;
    const key = (episode) => (by === "number" ? 0 : -parseFloat(episode.dataset[by]));
    const last = (value) => (Number.isNaN(value) ? Infinity : value);
    const sorted = episodes.map((episode, i) => ({ episode, i, key: last(key(episode)) }));
    sorted.sort((a, b) => (a.key === b.key ? a.i - b.i : a.key - b.key));
    list.append(...sorted.map((one) => one.episode));
  });
  // a link to an episode opens it
  const open = () => {
    const episode = of(decodeURIComponent(location.hash.slice(1)));
    if (episode instanceof HTMLDetailsElement) episode.open = true;
  };
  addEventListener("hashchange", open);
  open();
})();
