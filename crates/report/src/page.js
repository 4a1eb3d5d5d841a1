"use strict";
(() => {
  const table = document.getElementById("all");
  if (!table) return;
  const body = table.tBodies[0];
  // rows as the page is written, and those after them: data until they are shown
  const after = typeof rowsAfter === "undefined" ? [] : rowsAfter;
  const size = after.length ? body.rows.length : Infinity;
  const texts = (cell) => [...cell.childNodes].filter((node) => node.nodeName !== "BR").map((node) => node.textContent);
  const rows = [...body.rows].map((row) => ({ row, id: row.id, ...row.dataset, cells: [...row.cells].map(texts) }));
  rows.push(...after.map((data) => ({ ...data, row: null, cells: data.cells.map((cell) => cell.split("\n")) })));
  const headings = [...table.tHead.rows[0].cells];
  const element = (one) => {
    if (one.row) return one.row;
    one.row = document.createElement("tr");
    one.row.id = one.id;
    one.cells.forEach(([first, ...others], column) => {
      const cell = one.row.insertCell();
      if (headings[column].className) cell.className = headings[column].className;
      cell.textContent = first;
      others.forEach((other) => {
        const small = document.createElement("small");
        small.textContent = other;
        cell.append(document.createElement("br"), small);
      });
    });
    return one.row;
  };
  const shown = document.getElementById("shown");
  const place = document.getElementById("place");
  const [previous, next] = ["previous", "next"].map((id) => document.getElementById(id));
  let fitting = rows;
  let first = 0;
  const show = (from) => {
    first = from;
    const seen = fitting.slice(first, first + size);
    body.replaceChildren(...seen.map(element));
    if (!place) return;
    previous.disabled = first === 0;
    next.disabled = first + size >= fitting.length;
    place.textContent = seen.length ? `rows ${first + 1} to ${first + seen.length} of ${fitting.length}` : "";
  };
  if (place) {
    previous.addEventListener("click", () => show(Math.max(0, first - size)));
    next.addEventListener("click", () => show(first + size));
  }
  const number = (value) => {
    const found = value.replace(/,/g, "").match(/^[-+]?\d+(\.\d+)?([kM])?/);
    if (!found) return NaN;
    return parseFloat(found[0]) * ({ k: 1e3, M: 1e6 }[found[2]] || 1);
  };
  // filters
  const filters = [...document.querySelectorAll("[data-filter]")];
  const apply = () => {
    const wanted = filters.map((filter) => [filter.dataset.filter, filter.value.trim()]).filter(([, value]) => value);
    fitting = rows.filter((one) => wanted.every(([name, value]) =>
      name === "text" ? one.cells[0].join("").toLowerCase().includes(value.toLowerCase()) : one[name] === value));
    shown.textContent = `${fitting.length} of ${rows.length} rows`;
    show(0);
  };
  filters.forEach((filter) => filter.addEventListener("input", apply));
  document.querySelector("form.tools").addEventListener("submit", (event) => event.preventDefault());
  // sorting: a button in every heading
  const compare = new Intl.Collator().compare;
  headings.forEach((heading, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.innerHTML = heading.innerHTML;
    heading.replaceChildren(button);
    button.addEventListener("click", () => {
      const down = heading.getAttribute("aria-sort") !== "descending";
      headings.forEach((other) => other.removeAttribute("aria-sort"));
      heading.setAttribute("aria-sort", down ? "descending" : "ascending");
      const keyed = rows.map((one) => {
        const value = one.cells[column].join("");
        return { one, value, number: number(value) };
      });
      const numbers = keyed.filter((key) => !Number.isNaN(key.number)).length * 2 > keyed.length;
      keyed.sort((a, b) => {
        if (!numbers) return compare(a.value, b.value);
        // what has no number stands last, either way
        const [x, y] = [a.number, b.number];
        if (Number.isNaN(x) || Number.isNaN(y)) return (Number.isNaN(x) - Number.isNaN(y)) * (down ? -1 : 1);
        return x - y;
      });
      if (down) keyed.reverse();
      rows.splice(0, rows.length, ...keyed.map((key) => key.one));
      apply();
    });
  });
  apply();
  // columns: the first always, the others as they are chosen
  const chosen = document.getElementById("columns");
  const rules = document.head.appendChild(document.createElement("style"));
  const hide = () => {
    const hidden = [...chosen.querySelectorAll("input:not(:checked)")].map((box) => `#all tr > :nth-child(${+box.value + 1})`);
    rules.textContent = hidden.length ? `${hidden.join(", ")} { display: none; }` : "";
  };
  headings.slice(1).forEach((heading, at) => {
    const [label, box] = ["label", "input"].map((name) => document.createElement(name));
    [box.type, box.value, box.checked] = ["checkbox", at + 1, !("more" in heading.dataset)];
    label.append(box, ` ${texts(heading.firstChild).join(" ")}`);
    chosen.append(label);
  });
  chosen.addEventListener("change", hide);
  chosen.parentElement.hidden = false;
  hide();
  const copy = async (text) => {
    try {
      await navigator.clipboard.writeText(text);
    } catch {
      // a page from a file may not have a clipboard of its own
      const area = document.createElement("textarea");
      area.value = text;
      document.body.append(area);
      area.select();
      document.execCommand("copy");
      area.remove();
    }
  };
  // beside every command a button that copies it, once its details are open
  document.addEventListener("toggle", ({ target }) => {
    if (!(target instanceof HTMLDetailsElement) || !target.open) return;
    target.querySelectorAll("code.command:not([data-copies])").forEach((command) => {
      command.dataset.copies = "yes";
      const button = document.createElement("button");
      [button.type, button.className, button.textContent] = ["button", "copy", "Copy"];
      button.setAttribute("aria-label", `Copy ${command.textContent}`);
      button.addEventListener("click", async () => {
        await copy(command.textContent);
        button.removeAttribute("aria-label");
        button.textContent = "Copied";
        button.focus();
      });
      command.after(button);
    });
  }, true);
  // what fits the filters, as CSV
  const quoted = (value) => (/[",\n]/.test(value) ? `"${value.replace(/"/g, '""')}"` : value);
  const line = (cells) => cells.map((cell) => quoted(cell.map((text) => text.trim()).join("; "))).join(",");
  document.getElementById("copy").addEventListener("click", async () => {
    const named = headings.map((heading) => texts(heading.firstChild));
    const csv = [named, ...fitting.map((one) => one.cells)].map(line).join("\n") + "\n";
    await copy(csv);
    shown.textContent = `${fitting.length} rows copied`;
  });
  // a link to a row opens its details, or turns to it
  const open = () => {
    const name = decodeURIComponent(location.hash.slice(1));
    const details = document.getElementById(`details-${name}`) || document.getElementById(name);
    for (let one = details; one; one = one.parentElement?.closest("details")) {
      if (one instanceof HTMLDetailsElement) one.open = true;
    }
    const linked = rows.find((one) => one.id === name);
    if (!linked || linked.row?.isConnected) return;
    if (!fitting.includes(linked)) {
      filters.forEach((filter) => { filter.value = ""; });
      apply();
    }
    show(Math.floor(fitting.indexOf(linked) / size) * size);
    rows.forEach((one) => one.row?.classList.toggle("linked", one === linked));
    linked.row.scrollIntoView({ block: "center" });
  };
  addEventListener("hashchange", open);
  open();
})();
