'use strict';
(() => {
  const SVG = 'http://www.w3.org/2000/svg';
  const byId = (id) => document.getElementById(id);
  const index = JSON.parse(byId('index').textContent);
  const rows = index.rows.map((values, i) => {
    const row = Object.fromEntries(index.keys.map((key, k) => [key, values[k]]));
    row.i = i;
    row.text = [row.id, row.category, row.instance, row.source, row.reason, row.warning_texts]
      .filter(Boolean).join('\n').toLowerCase();
    return row;
  });
  const body = byId('table').tBodies[0];
  const lines = [...body.rows];
  const controls = { q: byId('q'), status: byId('status'), category: byId('category'), sort: byId('sort') };

  // Names are data: elements are only ever made here, never parsed from text.
  function make(tag, attributes, ...children) {
    const element = ['svg', 'path', 'line', 'circle', 'g', 'image', 'title', 'ellipse'].includes(tag)
      ? document.createElementNS(SVG, tag) : document.createElement(tag);
    for (const [key, value] of Object.entries(attributes || {})) {
      if (value !== null && value !== undefined) element.setAttribute(key, value);
    }
    element.append(...children.filter((child) => child !== null && child !== undefined));
    return element;
  }
  const jpeg = (data) => 'data:image/jpeg;base64,' + data;
  const number = (value, digits = 0) => value === null || value === undefined ? '–'
    : value.toLocaleString('en', { minimumFractionDigits: digits, maximumFractionDigits: digits });
  const percent = (value, digits = 0) => value === null || value === undefined ? '–' : (value * 100).toFixed(digits) + '%';

  function bytes(text) {
    const raw = atob(text), array = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) array[i] = raw.charCodeAt(i);
    return array;
  }

  // ---- contact sheets: an empty article each, filled when it comes near the window ----
  const sheets = rows.map((row) => make('article', { class: 'sheet', id: 's' + row.i, 'aria-labelledby': 'n' + row.i }));
  const filled = new Set();
  const watcher = new IntersectionObserver((entries) => {
    for (const entry of entries) if (entry.isIntersecting) fill(Number(entry.target.id.slice(1)));
  }, { rootMargin: '900px 0px' });

  function fill(i) {
    if (filled.has(i)) return;
    filled.add(i);
    watcher.unobserve(sheets[i]);
    const row = rows[i], store = byId('d' + i);
    const data = store ? JSON.parse(store.textContent) : {};
    const sheet = sheets[i];
    sheet.append(make('div', { class: 'head' },
      make('h3', { id: 'n' + i }, row.id), make('span', { class: 'status ' + row.status }, row.status),
      row.category ? make('span', { class: 'tag' }, row.category) : null,
      row.source ? make('span', { class: 'source', title: row.source }, row.source) : null));
    if (row.reason) sheet.append(make('p', { class: 'reason' }, (row.stage ? row.stage + ': ' : '') + row.reason));
    sheet.append(figures(row));
    const shown = data.frames || [];
    if (shown.length || data.orbit) {
      sheet.append(make('div', { class: shown.length && data.orbit ? 'look' : 'look lone' },
        shown.length ? strip(shown, data.range) : null, data.orbit ? orbit(data.orbit, row) : null));
    }
    if (data.pairs && data.pairs.length) sheet.append(make('div', { class: 'pairs' }, ...data.pairs.map(pair)));
    sheet.append(rest(row, data));
  }

  function figures(row) {
    const list = make('dl', { class: 'figures' });
    const add = (name, value, small) => list.append(make('div', null, make('dt', null, name),
      make('dd', null, value, small ? make('small', null, ' ' + small) : null)));
    const of = (whole) => whole === null ? null : 'of ' + number(whole);
    if (row.kept !== null) add('frames kept', number(row.kept), of(row.frames));
    if (row.registered !== null) {
      add('registered', percent(row.registered_share), number(row.registered) + ' frames');
    }
    if (row.error_px !== null) add('reprojection error', number(row.error_px, 2), 'px');
    if (row.points !== null) add('sparse points', number(row.points));
    if (row.depth_coverage !== null) add('depth coverage', percent(row.depth_coverage));
    if (row.depth_error !== null) add('off the sparse points', percent(row.depth_error, 2));
    if (row.masks !== null) {
      add('masks', number(row.masks), row.masks_flagged ? number(row.masks_flagged) + ' doubted' : row.masks_from);
    }
    if (row.pairs !== null) add('pairs', number(row.pairs), row.views === null ? null : 'of ' + number(row.views) + ' views');
    if (row.correspondences !== null) add('correspondences a pair', number(row.correspondences));
    if (row.cpu_seconds !== null) add('CPU', number(row.cpu_seconds, 0), 's');
    return list;
  }

  function strip(frames, range) {
    const withDepth = frames.some((frame) => frame.depth);
    return make('div', { class: 'frames' }, ...frames.map((frame) => {
      const [w, h] = frame.size;
      const what = 'Frame ' + frame.frame + (frame.mask ? ' with the outline of its mask' : '');
      const picture = make('svg', { viewBox: `0 0 ${w} ${h}`, role: 'img', 'aria-label': what },
        make('title', null, what + (frame.name ? ', ' + frame.name : '')),
        make('image', { href: jpeg(frame.image), width: w, height: h }));
      if (frame.mask) {
        const scale = `scale(${w / 1000} ${h / 1000})`;
        picture.append(make('path', { class: 'outline', d: 'M0 0H1000V1000H0Z' + frame.mask, transform: scale }),
          make('path', { class: 'edge', d: frame.mask, transform: scale }));
      }
      const doubts = [frame.registered ? null : 'no camera', frame.mask === '' ? 'empty mask' : null, frame.flag ? 'mask doubted' : null];
      const doubt = doubts.filter(Boolean).join(', ');
      return make('figure', null, picture,
        frame.depth ? make('img', { src: jpeg(frame.depth), alt: `Depth of frame ${frame.frame}, known for ${percent(frame.known)} of it` +
          (range ? `, colours from ${range[0]} to ${range[1]}` : '') })
          : withDepth ? make('div', { class: 'none' }, 'no depth') : null,
        make('figcaption', { title: frame.flag }, '#' + frame.frame, doubt ? make('b', null, ' ' + doubt) : null));
    }));
  }

  function pair(data) {
    const size = 1000, gap = 24, group = make('g');
    const caption = `${number(data.angle, 0)}° apart, ${percent(data.overlap)} overlap, ${number(data.n)} correspondences`;
    const svg = make('svg', { viewBox: `0 0 ${2 * size + gap} ${size}`, role: 'img',
      'aria-label': `Views ${data.frames[0]} and ${data.frames[1]}: ${caption}` },
    make('image', { href: jpeg(data.views[0]), width: size, height: size }),
    make('image', { href: jpeg(data.views[1]), x: size + gap, width: size, height: size }), group);
    const count = data.points.length / 4;
    let middle = [0, 0];
    for (let k = 0; k < count; k++) middle = [middle[0] + data.points[4 * k] / count, middle[1] + data.points[4 * k + 1] / count];
    for (let k = 0; k < count; k++) {
      const [x1, y1, x2, y2] = data.points.slice(4 * k, 4 * k + 4);
      const hue = Math.round(Math.atan2(y1 - middle[1], x1 - middle[0]) * 180 / Math.PI + 360) % 360;
      const colour = `hsl(${hue} 78% 56%)`;
      group.append(make('g', null,
        make('line', { x1, y1, x2: x2 + size + gap, y2, stroke: colour, 'vector-effect': 'non-scaling-stroke' }),
        make('circle', { cx: x1, cy: y1, r: 17, fill: colour, 'vector-effect': 'non-scaling-stroke' }),
        make('circle', { cx: x2 + size + gap, cy: y2, r: 17, fill: colour, 'vector-effect': 'non-scaling-stroke' })));
    }
    return make('figure', null, svg, make('figcaption', null, `#${data.frames[0]} and #${data.frames[1]}: ${caption}`));
  }

  function orbit(data, row) {
    const half = 150, poses = new Int16Array(bytes(data.cameras).buffer), xyz = new Int8Array(bytes(data.points).buffer);
    const rgb = bytes(data.colours), count = poses.length / 9, points = [], frusta = [], place = (k) => [0, 1, 2].map((a) => poses[9 * k + a] / 32767);
    const label = `${number(data.n)} cameras around ${number(row.points === null ? xyz.length / 3 : row.points)} points`;
    const svg = make('svg', { viewBox: `${-half} ${-half} ${2 * half} ${2 * half}`, role: 'img', tabindex: 0,
      'aria-label': label + '. Arrow keys turn it.' });
    const ground = svg.appendChild(make('path', { class: 'ground' })), path = svg.appendChild(make('path', { class: 'path' }));
    for (let k = 0; k < xyz.length / 3; k++) {
      points.push(svg.appendChild(make('circle', { r: 1.25, fill: `rgb(${rgb[3 * k]} ${rgb[3 * k + 1]} ${rgb[3 * k + 2]})` })));
    }
    for (let k = 0; k < count; k++) {
      const colour = `hsl(${Math.round(190 + 140 * k / Math.max(1, count - 1))} 58% 50%)`;
      frusta.push(svg.appendChild(make('path', { class: 'frustum', stroke: colour }, make('title', null, 'Frame ' + data.frames[k]))));
    }
    let yaw = 0.6, pitch = 0.55;
    function draw() {
      const cy = Math.cos(yaw), sy = Math.sin(yaw), cp = Math.cos(pitch), sp = Math.sin(pitch);
      const project = (x, y, z) => {
        const across = cy * x - sy * y, back = sy * x + cy * y, away = cp * back - sp * z;
        const scale = 108 * 4.2 / (4.2 + away);
        return [across * scale, -(sp * back + cp * z) * scale];
      };
      const text = (list) => list.map((v) => v.map((c) => c.toFixed(1)).join(' ')).join('L');
      for (let k = 0; k < points.length; k++) {
        const [u, v] = project(...[0, 1, 2].map((a) => xyz[3 * k + a] * 1.25 / 127));
        points[k].setAttribute('cx', u.toFixed(1)); points[k].setAttribute('cy', v.toFixed(1));
      }
      const ring = [];
      for (let k = 0; k < 48; k++) ring.push(project(Math.cos(k * Math.PI / 24), Math.sin(k * Math.PI / 24), 0));
      ground.setAttribute('d', 'M' + text(ring) + 'Z');
      path.setAttribute('d', 'M' + text(Array.from({ length: count }, (_, k) => project(...place(k)))));
      for (let k = 0; k < count; k++) {
        const value = (a) => poses[9 * k + a] / 32767, size = Math.max(0.05, 0.12 - count / 1500);
        const c = place(k), f = [3, 4, 5].map(value), r = [6, 7, 8].map(value);
        const d = [f[1] * r[2] - f[2] * r[1], f[2] * r[0] - f[0] * r[2], f[0] * r[1] - f[1] * r[0]];
        const corner = (s, t) => project(...c.map((v, a) => v + size * (f[a] + 0.62 * s * r[a] + 0.48 * t * d[a])));
        const corners = [corner(-1, -1), corner(1, -1), corner(1, 1), corner(-1, 1)], eye = project(...c);
        frusta[k].setAttribute('d', 'M' + text(corners) + 'Z' + corners.map((p) => 'M' + text([eye, p])).join(''));
      }
    }
    const turn = (dx, dy) => { yaw -= dx; pitch = Math.min(1.57, Math.max(-0.3, pitch + dy)); draw(); };
    let from = null;
    svg.addEventListener('pointerdown', (event) => { from = [event.clientX, event.clientY]; svg.setPointerCapture(event.pointerId); });
    svg.addEventListener('pointermove', (event) => {
      if (!from) return;
      turn((event.clientX - from[0]) / 90, (event.clientY - from[1]) / 90);
      from = [event.clientX, event.clientY];
    });
    for (const name of ['pointerup', 'pointercancel']) svg.addEventListener(name, () => { from = null; });
    svg.addEventListener('keydown', (event) => {
      const step = { ArrowLeft: [-0.15, 0], ArrowRight: [0.15, 0], ArrowUp: [0, 0.12], ArrowDown: [0, -0.12] }[event.key];
      if (step) { turn(...step); event.preventDefault(); }
    });
    draw();
    return make('figure', { class: 'orbit' }, svg, make('figcaption', null, label + '; drag to turn'));
  }

  function rest(row, data) {
    const box = make('div', { class: 'more' });
    box.append(make('ul', { class: 'stages', 'aria-label': 'Stages' }, ...index.stages.map((stage) => {
      const state = row['stage_' + stage];
      return make('li', { class: state ? 'status ' + (state === 'damaged' ? 'failed' : state) : 'none', title: state || 'not run' },
        stage + (state && state !== 'ok' ? ' ' + state : ''));
    })));
    const attempts = data.attempts || [];
    if (attempts.length) {
      const head = ['attempt', 'matching', 'size', 'pairs', 'registered', 'points', 'error', 'seconds', 'verdict'];
      box.append(make('table', { 'aria-label': 'Attempts at reconstruction' },
        make('thead', null, make('tr', null, ...head.map((text, k) => make('th', { scope: 'col', class: k > 1 && k < 8 ? 'num' : null }, text)))),
        make('tbody', null, ...attempts.map((a) => make('tr', null,
          make('td', null, [a.rung, a.mapper].filter(Boolean).join(', ') || '–'), make('td', null, a.matching || '–'),
          ...[number(a.max_image_size), number(a.n_pairs), number(a.n_registered) + (a.n_frames === null ? '' : '/' + a.n_frames),
            number(a.n_points), a.mean_error_px === null ? '–' : number(a.mean_error_px, 2) + ' px', number(a.seconds, 1)]
            .map((text) => make('td', { class: 'num' }, text)),
          make('td', null, a.verdict || '–'))))));
    }
    const words = [...(row.warning_texts ? row.warning_texts.split(' | ') : []), ...(data.notes || []).map((text) => 'not shown: ' + text)];
    if (words.length) box.append(make('ul', { class: 'warn', 'aria-label': 'Warnings' }, ...words.map((text) => make('li', null, text))));
    return box;
  }

  // ---- search, filter, order; the state lies in the address: #?q=..&status=..&category=..&sort=-key ----
  const sorts = [['', 'by name'], ['registered_share', 'fewest registered'], ['-error_px', 'largest reprojection error'],
    ['depth_coverage', 'least depth'], ['-depth_error', 'worst depth'], ['pairs', 'fewest pairs'], ['-cpu_seconds', 'most CPU']];
  for (const [value, text] of sorts) controls.sort.append(make('option', { value }, text));
  for (const key of ['status', 'category']) {
    const counts = new Map();
    for (const row of rows) if (row[key] !== null) counts.set(row[key], (counts.get(row[key]) || 0) + 1);
    for (const value of [...counts.keys()].sort()) {
      const option = make('option', null, `${value} (${number(counts.get(value))})`);
      option.value = value;
      controls[key].append(option);
    }
    if (key === 'category' && counts.size < 2) controls.category.parentElement.hidden = true;
  }

  function order(key) {
    const down = key.startsWith('-') ? -1 : 1, name = key.replace(/^-/, '');
    return (a, b) => {
      const x = a[name], y = b[name];
      if (x === null || y === null) return (x === null) - (y === null) || a.i - b.i;
      return down * (typeof x === 'string' ? x.localeCompare(y, 'en', { numeric: true }) : x - y) || a.i - b.i;
    };
  }

  function apply() {
    const q = controls.q.value.trim().toLowerCase(), { status, category } = controls;
    const shown = rows.filter((row) => (!q || row.text.includes(q)) && (!status.value || row.status === status.value)
      && (!category.value || row.category === category.value));
    const key = controls.sort.value;
    if (index.keys.includes(key.replace(/^-/, ''))) shown.sort(order(key));
    body.replaceChildren(...shown.map((row) => lines[row.i]));
    byId('sheets').replaceChildren(...shown.map((row) => sheets[row.i]));
    for (const row of shown) if (!filled.has(row.i)) watcher.observe(sheets[row.i]);
    byId('count').textContent = shown.length === rows.length ? `${number(rows.length)} sequences`
      : `${number(shown.length)} of ${number(rows.length)} sequences`;
    for (const head of document.querySelectorAll('#table th[data-key]')) {
      const mine = key.replace(/^-/, '') === head.dataset.key;
      head.setAttribute('aria-sort', !mine ? 'none' : key.startsWith('-') ? 'descending' : 'ascending');
    }
    return shown.length;
  }

  function setSort(key) {
    if (![...controls.sort.options].some((option) => option.value === key)) {
      controls.sort.append(make('option', { value: key }, (key.startsWith('-') ? 'largest ' : 'smallest ') + key.replace(/^-/, '').replaceAll('_', ' ')));
    }
    controls.sort.value = key;
  }

  function readAddress() {
    if (location.hash.startsWith('#?')) {
      const given = new URLSearchParams(location.hash.slice(2));
      for (const key of ['q', 'status', 'category']) controls[key].value = given.get(key) || '';
      for (const key of ['status', 'category']) if (controls[key].selectedIndex < 0) controls[key].value = '';
      const sort = given.get('sort') || '';
      if (!sort || index.keys.includes(sort.replace(/^-/, ''))) setSort(sort);
    }
    apply();
    const target = /^#s\d+$/.test(location.hash) && byId(location.hash.slice(1));
    if (target) { fill(Number(location.hash.slice(2))); target.scrollIntoView({ behavior: 'instant' }); }
  }

  function writeAddress() {
    const state = new URLSearchParams();
    for (const [key, control] of Object.entries(controls)) if (control.value) state.set(key, control.value);
    const text = state.toString();
    try { history.replaceState(null, '', text ? '#?' + text : '#'); } catch { /* some viewers forbid it */ }
    apply();
  }

  for (const control of Object.values(controls)) control.addEventListener('input', writeAddress);
  document.querySelector('form.bar').addEventListener('submit', (event) => event.preventDefault());
  for (const head of document.querySelectorAll('#table th[data-key]')) {
    head.querySelector('button').addEventListener('click', () => {
      const key = head.dataset.key, now = controls.sort.value;
      setSort(now === key ? '-' + key : key);
      writeAddress();
    });
  }
  window.addEventListener('hashchange', readAddress);
  window.addEventListener('beforeprint', () => { // all that is chosen, but no more than a printer would want
    for (const sheet of [...byId('sheets').children].slice(0, 200)) if (sheet.id) fill(Number(sheet.id.slice(1)));
  });
  for (const sheet of sheets) sheet.setAttribute('aria-label', 'Contact sheet of ' + rows[Number(sheet.id.slice(1))].id);
  readAddress();
  document.documentElement.dataset.rows = String(lines.length);
  window.addEventListener('load', () => { document.documentElement.dataset.milliseconds = String(Math.round(performance.now())); });
})();
