"use strict";
(() => {
  const table = document.getElementById("all");
  if (!table) return;
  const body = table.tBodies[0];
  const rows = [...body.rows];
  const text = (cell) => cell.innerText.trim();
  const number = (value) => {
    const found = value.replace(/,/g, "").match(/^[-+]?\d+(\.\d+)?([kM])?/);
    if (!found) return NaN;
    return parseFloat(found[0]) * ({ k: 1e3, M: 1e6 }[found[2]] || 1);
  };
  // sorting: a button in every heading
  [...table.tHead.rows[0].cells].forEach((heading, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.innerHTML = heading.innerHTML;
    heading.replaceChildren(button);
    button.addEventListener("click", () => {
      const down = heading.getAttribute("aria-sort") !== "descending";
      [...table.tHead.rows[0].cells].forEach((other) => other.removeAttribute("aria-sort"));
      heading.setAttribute("aria-sort", down ? "descending" : "ascending");
      const keyed = rows.map((row) => {
        const value = row.cells[column].textContent;
        return { row, value, number: number(value) };
      });
      const numbers = keyed.filter((key) => !Number.isNaN(key.number)).length * 2 > keyed.length;
      keyed.sort((a, b) => {
        if (!numbers) return a.value.localeCompare(b.value);
        // what has no number stands last, either way
        const [x, y] = [a.number, b.number];
        if (Number.isNaN(x) || Number.isNaN(y)) return (Number.isNaN(x) - Number.isNaN(y)) * (down ? -1 : 1);
        return x - y;
      });
      if (down) keyed.reverse();
      const sorted = document.createDocumentFragment();
      keyed.forEach((key) => sorted.append(key.row));
      body.append(sorted);
    });
  });
  // filters
  const filters = [...document.querySelectorAll("[data-filter]")];
  const shown = document.getElementById("shown");
  const apply = () => {
    let count = 0;
    rows.forEach((row) => {
      const fits = filters.every((filter) => {
        const wanted = filter.value.trim();
        if (!wanted) return true;
        if (filter.dataset.filter === "text") return row.cells[0].textContent.toLowerCase().includes(wanted.toLowerCase());
        return row.dataset[filter.dataset.filter] === wanted;
      });
      row.hidden = !fits;
      count += fits ? 1 : 0;
    });
    shown.textContent = `${count} of ${rows.length} rows`;
  };
  filters.forEach((filter) => filter.addEventListener("input", apply));
  document.querySelector("form.tools").addEventListener("submit", (event) => event.preventDefault());
  apply();
  // what is seen, as CSV
  const quoted = (value) => (/[",\n]/.test(value) ? `"${value.replace(/"/g, '""')}"` : value);
  const line = (row) => [...row.cells].map((cell) => quoted(text(cell).replace(/\s*\n\s*/g, "; "))).join(",");
  document.getElementById("copy").addEventListener("click", async () => {
    const seen = [...body.rows].filter((row) => !row.hidden);
    const csv = [table.tHead.rows[0], ...seen].map(line).join("\n") + "\n";
    try {
      await navigator.clipboard.writeText(csv);
    } catch {
      // a page from a file may not have a clipboard of its own
      const area = document.createElement("textarea");
      area.value = csv;
      document.body.append(area);
      area.select();
      document.execCommand("copy");
      area.remove();
    }
    shown.textContent = `${seen.length} rows copied`;
  });
  // a link to a row opens its details
  const open = () => {
    const name = decodeURIComponent(location.hash.slice(1));
    const details = document.getElementById(`details-${name}`) || document.getElementById(name);
    if (details instanceof HTMLDetailsElement) details.open = true;
  };
  addEventListener("hashchange", open);
  open();
})();
