/* Plots of the report: inline SVG from the data embedded in the page. No library, no network. */
(function () {
  'use strict';
  const data = JSON.parse(document.getElementById('curves').textContent);
  const NS = 'http://www.w3.org/2000/svg';
  const MARGIN = { left: 66, right: 14, top: 8, bottom: 34 };
  const SUPERSCRIPT = { '-': '\u207b', 0: '\u2070', 1: '\u00b9', 2: '\u00b2', 3: '\u00b3',
    4: '\u2074', 5: '\u2075', 6: '\u2076', 7: '\u2077', 8: '\u2078', 9: '\u2079' };

  // --- data ---------------------------------------------------------------------------------
  function bytes(text) {
    const raw = atob(text);
    const out = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) out[i] = raw.charCodeAt(i);
    return new DataView(out.buffer);
  }
  function decoded(entry) {
    if (!entry) return null;
    if (entry.values) return entry.values;
    const view = bytes(entry.b);
    const out = new Float64Array(view.byteLength / 2);
    for (let i = 0; i < out.length; i++) {
      const step = view.getUint16(2 * i, true);
      out[i] = step === 0xffff ? NaN : entry.lo + entry.span * step / 0xfffe;
    }
    entry.values = out;
    return out;
  }
  function times(entry) {
    if (entry.values) return entry.values;
    const view = bytes(entry.b);
    const out = new Float64Array(entry.n);
    for (let i = 0; i < entry.n; i++) out[i] = view.getFloat32(4 * i, true);
    entry.values = out;
    return out;
  }
  function sum(a, b) {
    const out = new Float64Array(a.length);
    for (let i = 0; i < a.length; i++) out[i] = a[i] + b[i];
    return out;
  }
  function extent(series, from, to) {
    let lo = Infinity, hi = -Infinity;
    for (const y of series) {
      if (!y) continue;
      for (let i = from; i < to; i++) {
        if (y[i] < lo) lo = y[i];
        if (y[i] > hi) hi = y[i];
      }
    }
    return lo <= hi ? [lo, hi] : [-1, 1];
  }
  function first(x, value) {
    let a = 0, b = x.length;
    while (a < b) {
      const m = (a + b) >> 1;
      if (x[m] < value) a = m + 1; else b = m;
    }
    return a;
  }

  // --- words --------------------------------------------------------------------------------
  function scaled(largest, unit) {
    if (unit === '1') return [1, ''];
    if (['rad', 'rad/s', 's', 'm', 'm/s'].indexOf(unit) >= 0) {
      if (largest < 1e-4) return [1e6, '\u00b5' + unit];
      if (largest < 0.0995) return [1e3, 'm' + unit];
    }
    return [1, unit];
  }
  function label(value, step) {
    if (value === 0) return '0';
    const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    return value.toFixed(Math.min(digits, 8)).replace('-', '\u2212');
  }
  function short(value) {
    if (!isFinite(value)) return '\u2013';
    const size = Math.abs(value);
    const text = size !== 0 && (size < 1e-3 || size >= 1e5)
      ? value.toExponential(2) : value.toPrecision(4);
    return text.replace('-', '\u2212');
  }
  function power(exponent) {
    return '10' + String(exponent).split('').map((c) => SUPERSCRIPT[c]).join('');
  }

  // --- one chart ----------------------------------------------------------------------------
  function node(name, attributes, parent, text) {
    const made = document.createElementNS(NS, name);
    for (const key in attributes) made.setAttribute(key, attributes[key]);
    if (text !== undefined) made.textContent = text;
    if (parent) parent.appendChild(made);
    return made;
  }
  const COLOURS = 7; // of torques (page.css)
  function words(name) { return name.replace(/_/g, ' '); }
  function html(name, cls, parent, text) {
    const made = document.createElement(name);
    if (cls) made.className = cls;
    if (text !== undefined) made.textContent = text;
    if (parent) parent.appendChild(made);
    return made;
  }
  function linearTicks(lo, hi, count) {
    const raw = (hi - lo) / Math.max(1, count);
    const size = Math.pow(10, Math.floor(Math.log10(raw)));
    const step = [1, 2, 5, 10].map((m) => m * size).find((s) => s >= raw) || raw;
    const ticks = [];
    for (let k = Math.ceil(lo / step - 1e-9); k * step <= hi + 1e-9 * step; k++) {
      ticks.push({ at: k * step, text: label(k * step, step) });
    }
    return ticks;
  }
  function logTicks(lo, hi, count) {
    const a = Math.ceil(Math.log10(lo) - 1e-9), b = Math.floor(Math.log10(hi) + 1e-9);
    const every = Math.max(1, Math.ceil((b - a + 1) / count));
    const ticks = [];
    for (let k = a; k <= b; k++) {
      const plain = k >= -1 && k <= 3;
      const text = (k - a) % every ? '' : plain ? String(Math.pow(10, k)) : power(k);
      ticks.push({ at: Math.pow(10, k), text: text });
    }
    return ticks;
  }
  function axis(spec, from, to) {
    const map = spec.log
      ? (v) => from + (to - from) * (Math.log10(v) - Math.log10(spec.lo)) /
        (Math.log10(spec.hi) - Math.log10(spec.lo))
      : (v) => from + (to - from) * (v - spec.lo) / (spec.hi - spec.lo);
    map.inverse = (p) => spec.lo + (spec.hi - spec.lo) * (p - from) / (to - from);
    return map;
  }

  function path(x, y, px, py, spec) {
    // At most four points per column of pixels: first, lowest, highest, last.
    const from = spec.log ? 0 : Math.max(0, first(x, spec.lo) - 1);
    const to = spec.log ? x.length : Math.min(x.length, first(x, spec.hi) + 2);
    let gap = Infinity;
    if (to - from > 8) gap = 12 * (x[to - 1] - x[from]) / (to - from);
    const out = [];
    let column = NaN, low = 0, high = 0, last = 0, count = 0, at = 0, previous = NaN;
    function flush() {
      if (count > 1) {
        out.push('L' + at + ' ' + low.toFixed(1) + 'L' + at + ' ' + high.toFixed(1));
        out.push('L' + at + ' ' + last.toFixed(1));
      }
      count = 0;
    }
    for (let i = from; i < to; i++) {
      const v = y[i];
      if (!isFinite(v) || (spec.log && x[i] <= 0)) continue;
      const p = px(x[i]), q = py(v);
      if (!isFinite(q)) continue;
      const pixel = Math.round(p * 2);
      const broken = !(x[i] - previous < gap) && !spec.log;
      previous = x[i];
      if (pixel === column && !broken) {
        low = Math.min(low, q); high = Math.max(high, q); last = q; count++;
        continue;
      }
      flush();
      out.push((broken || !out.length ? 'M' : 'L') + p.toFixed(1) + ' ' + q.toFixed(1));
      column = pixel; low = high = last = q; count = 1; at = p.toFixed(1);
    }
    flush();
    return out.join('');
  }

  let clips = 0;
  function chart(host, spec) {
    host.textContent = '';
    const width = Math.max(220, host.clientWidth), height = spec.height;
    const bottom = spec.x.label || spec.x.numbers ? MARGIN.bottom : 10;
    const left = spec.left || MARGIN.left;
    const frame = { x0: left, x1: width - MARGIN.right, y0: height - bottom, y1: MARGIN.top };
    const svg = node('svg', { viewBox: '0 0 ' + width + ' ' + height, width: '100%',
      role: 'img', 'aria-label': spec.title }, host);
    const px = axis(spec.x, frame.x0, frame.x1), py = axis(spec.y, frame.y0, frame.y1);
    const id = 'clip' + (clips++);
    const clip = node('clipPath', { id: id }, node('defs', {}, svg));
    node('rect', { x: frame.x0, y: frame.y1, width: frame.x1 - frame.x0,
      height: frame.y0 - frame.y1 }, clip);
    const grid = node('g', { class: 'grid' }, svg), text = node('g', { class: 'ticks' }, svg);
    const room = (frame.x1 - frame.x0) / (width > 500 ? 80 : 52), tall = (frame.y0 - frame.y1) / 34;
    for (const t of (spec.x.log ? logTicks : linearTicks)(spec.x.lo, spec.x.hi, room)) {
      node('line', { x1: px(t.at), x2: px(t.at), y1: frame.y0, y2: frame.y1 }, grid);
      if (spec.x.label || spec.x.numbers) {
        node('text', { x: px(t.at), y: frame.y0 + 14, 'text-anchor': 'middle' }, text, t.text);
      }
    }
    for (const t of (spec.y.log ? logTicks : linearTicks)(spec.y.lo, spec.y.hi, tall)) {
      node('line', { x1: frame.x0, x2: frame.x1, y1: py(t.at), y2: py(t.at) }, grid);
      node('text', { x: frame.x0 - 7, y: py(t.at) + 3.5, 'text-anchor': 'end' }, text, t.text);
    }
    if (spec.x.label) {
      node('text', { x: (frame.x0 + frame.x1) / 2, y: height - 3, 'text-anchor': 'middle',
        class: 'label' }, text, spec.x.label);
    }
    const middle = (frame.y0 + frame.y1) / 2;
    node('text', { x: 12, y: middle, 'text-anchor': 'middle', class: 'label',
      transform: 'rotate(-90 12 ' + middle + ')' }, text, spec.y.label);
    const body = node('g', { 'clip-path': 'url(#' + id + ')' }, svg);
    for (const band of spec.bands || []) {
      if (band.flat !== undefined) {
        const a = py(band.flat), b = py(-band.flat);
        node('rect', { x: frame.x0, width: frame.x1 - frame.x0, y: Math.min(a, b),
          height: Math.max(1, Math.abs(b - a)), class: band.cls }, body);
        continue;
      }
      const up = band.x.map((v, i) => px(v).toFixed(1) + ' ' + py(band.hi[i]).toFixed(1));
      const down = band.x.map((v, i) => px(v).toFixed(1) + ' ' + py(band.lo[i]).toFixed(1));
      node('path', { d: 'M' + up.concat(down.reverse()).join('L') + 'Z', class: band.cls }, body);
    }
    for (const level of spec.levels || []) {
      node('line', { x1: frame.x0, x2: frame.x1, y1: py(level.at), y2: py(level.at),
        class: level.cls }, body);
    }
    for (const line of spec.lines) {
      if (!line.y) continue;
      node('path', { d: path(line.x, line.y, px, py, spec.x), class: 'line ' + line.cls }, body);
    }
    node('rect', { x: frame.x0, y: frame.y1, width: frame.x1 - frame.x0,
      height: frame.y0 - frame.y1, class: 'frame' }, svg);
    return { svg: svg, px: px, frame: frame, width: width };
  }
  function padded(range, share, least) {
    const pad = Math.max(share * (range[1] - range[0]), least || 1e-12);
    return [range[0] - pad, range[1] + pad];
  }
  function times1(y, factor) {
    if (!y) return null;
    const out = new Float64Array(y.length);
    for (let i = 0; i < y.length; i++) out[i] = factor * y[i];
    return out;
  }

  // --- measured and simulated in time -------------------------------------------------------
  const viewer = document.getElementById('viewer');
  if (viewer && data.records.length) viewerOf(viewer);

  function viewerOf(root) {
    const state = { record: 0, channel: Number(root.dataset.channel) || 0, from: 0, to: 0,
      close: false };
    const both = root.dataset.both === '1';
    const select = root.querySelector('select'), tabs = root.querySelector('.tabs');
    const hosts = ['signal', 'residual', 'torque'].map((n) => root.querySelector('.' + n));
    const readout = root.querySelector('.readout');
    let drawn = [];

    data.channels.forEach((channel, j) => {
      const used = data.records.some((r) => r.outputs[j] && r.outputs[j].measured);
      if (!used) return;
      const tab = html('button', '', tabs, channel.name);
      tab.type = 'button';
      tab.onclick = () => { state.channel = j; draw(); };
      tab.dataset.index = j;
    });
    select.onchange = () => { state.record = Number(select.value); whole(); };
    root.querySelectorAll('[data-span]').forEach((button) => {
      button.onclick = () => span(Number(button.dataset.span));
    });
    root.querySelectorAll('[data-shift]').forEach((button) => {
      button.onclick = () => move(Number(button.dataset.shift));
    });
    const close = root.querySelector('input[type=checkbox]');
    if (close) close.onchange = () => { state.close = close.checked; draw(); };

    function record() { return data.records[state.record]; }
    function limits() {
      const t = times(record().time);
      return [t[0], t[t.length - 1]];
    }
    function whole() { [state.from, state.to] = limits(); draw(); }
    function span(length) {
      const [a, b] = limits();
      if (!length || length >= b - a) { whole(); return; }
      const middle = (state.from + state.to) / 2;
      const start = Math.min(Math.max(a, state.to - state.from > b - a - 1e-9
        ? a : middle - length / 2), b - length);
      state.from = start; state.to = start + length;
      draw();
    }
    function move(share) {
      const [a, b] = limits(), length = state.to - state.from;
      const start = Math.min(Math.max(a, state.from + share * length), b - length);
      state.from = start; state.to = start + length;
      draw();
    }

    function draw() {
      const r = record(), channel = data.channels[state.channel], t = times(r.time);
      const out = r.outputs[state.channel];
      tabs.querySelectorAll('button').forEach((b) => {
        b.setAttribute('aria-pressed', String(Number(b.dataset.index) === state.channel));
      });
      const x = { lo: state.from, hi: state.to };
      const from = Math.max(0, first(t, state.from) - 1), to = Math.min(t.length,
        first(t, state.to) + 1);
      drawn = [];
      if (!out || !out.measured) {
        hosts.forEach((h) => { h.textContent = ''; });
        hosts[0].textContent = 'This record has no ' + channel.name + '.';
        return;
      }
      const measured = decoded(out.measured);
      const res = { before: decoded(out.before), after: decoded(out.after) };
      const sim = { before: sum(measured, res.before), after: sum(measured, res.after) };
      let range = extent([measured, both ? sim.before : null, sim.after], from, to);
      let [k, unit] = scaled(Math.max(Math.abs(range[0]), Math.abs(range[1])), channel.unit);
      let y = padded([range[0] * k, range[1] * k], 0.06, 1e-9);
      const lines = [{ x: t, y: times1(measured, k), cls: 'measured' }];
      if (both) lines.push({ x: t, y: times1(sim.before, k), cls: 'before' });
      lines.push({ x: t, y: times1(sim.after, k), cls: 'after' });
      drawn.push(chart(hosts[0], { height: 230, x: x, lines: lines,
        title: channel.name + ', measured and simulated',
        y: { lo: y[0], hi: y[1], label: channel.name + ' in ' + unit } }));

      const shown = state.close || !both ? [res.after] : [res.before, res.after];
      range = extent(shown, from, to);
      const sigma = channel.sigma || 0;
      let top = Math.max(Math.abs(range[0]), Math.abs(range[1]), 2.5 * sigma);
      [k, unit] = scaled(top, channel.unit);
      top *= 1.08 * k;
      const left = [];
      if (both) left.push({ x: t, y: times1(res.before, k), cls: 'before' });
      left.push({ x: t, y: times1(res.after, k), cls: 'after' });
      drawn.push(chart(hosts[1], { height: 180, x: x, lines: left,
        title: 'residual of ' + channel.name,
        bands: [{ flat: 2 * sigma * k, cls: 'noise' }],
        y: { lo: -top, hi: top, label: 'residual in ' + unit } }));

      const inputs = r.inputs.slice(0, data.inputs.length).map(decoded);
      const pushes = data.input_units.map((of) => of === 'N' ? 'force' : 'torque');
      const driven = pushes.map((what, i) => what + ' in ' + data.input_units[i])
        .filter((text, i, all) => all.indexOf(text) === i).join(', ');
      y = padded(extent(inputs, from, to), 0.08, 0.1);
      drawn.push(chart(hosts[2], { height: 122, title: pushes[0],
        x: { lo: x.lo, hi: x.hi, label: 'time in s' },
        lines: inputs.map((v, i) => ({ x: t, y: v, cls: 'torque' + i % COLOURS })),
        y: { lo: y[0], hi: y[1], label: driven } }));
      if (inputs.length > 1) {
        const legend = html('div', 'legend', hosts[2]);
        data.inputs.forEach((name, i) => {
          const key = html('span', '', legend);
          html('i', 'k-torque' + i % COLOURS, key);
          key.append(words(name));
        });
      }
      drawn.forEach((d, i) => interactive(d, i, t, measured, sim, inputs, channel));
    }

    function interactive(d, index, t, measured, sim, inputs, channel) {
      const hair = node('line', { y1: d.frame.y1, y2: d.frame.y0, class: 'hair' }, d.svg);
      const mark = node('rect', { y: d.frame.y1, height: d.frame.y0 - d.frame.y1,
        class: 'drag' }, d.svg);
      d.hair = hair;
      let start = null;
      const at = (event) => {
        const box = d.svg.getBoundingClientRect();
        const p = (event.clientX - box.left) * d.width / box.width;
        return Math.min(Math.max(p, d.frame.x0), d.frame.x1);
      };
      d.svg.onpointermove = (event) => {
        const p = at(event), time = d.px.inverse(p);
        drawn.forEach((other) => {
          other.hair.setAttribute('x1', p); other.hair.setAttribute('x2', p);
          other.hair.style.display = 'inline';
        });
        let i = Math.min(t.length - 1, first(t, time));
        while (i > 0 && !isFinite(measured[i])) i--;
        const b = both ? '   before ' + short(sim.before[i]) : '';
        readout.textContent = 't ' + t[i].toFixed(3) + ' s   measured ' + short(measured[i]) + b +
          '   ' + (both ? 'after ' : 'simulated ') + short(sim.after[i]) + ' ' +
          (channel.unit === '1' ? '' : channel.unit) +
          inputs.map((v, k) => '   ' + (inputs.length > 1 ? words(data.inputs[k])
            : data.input_units[k] === 'N' ? 'force' : 'torque') + ' ' +
            short(v[i]) + ' ' + data.input_units[k]).join('');
        if (start !== null) {
          mark.setAttribute('x', Math.min(start, p));
          mark.setAttribute('width', Math.abs(p - start));
        }
      };
      d.svg.onpointerleave = () => {
        drawn.forEach((other) => { other.hair.style.display = 'none'; });
        readout.textContent = readout.dataset.hint;
      };
      d.svg.onpointerdown = (event) => {
        start = at(event);
        d.svg.setPointerCapture(event.pointerId);
      };
      d.svg.onpointerup = (event) => {
        const p = at(event);
        if (start !== null && Math.abs(p - start) > 6) {
          const a = d.px.inverse(Math.min(start, p)), b = d.px.inverse(Math.max(start, p));
          state.from = a; state.to = b;
          draw();
        }
        start = null;
        mark.setAttribute('width', 0);
      };
      d.svg.ondblclick = whole;
    }
    [state.from, state.to] = limits();
    root.redraw = draw;
    draw();
  }

  // --- spectra ------------------------------------------------------------------------------
  function spectrum(host) {
    const channel = data.channels.find((c) => c.name === host.dataset.channel);
    const s = data.spectra[channel.name];
    const both = host.dataset.both === '1';
    const series = both ? [s.before, s.after] : [s.after];
    const all = [].concat.apply(s.floor ? [s.floor] : [], series).filter((v) => v > 0);
    const lo = Math.min.apply(null, all), hi = Math.max.apply(null, all);
    const lines = [];
    if (both) lines.push({ x: s.f, y: s.before, cls: 'before' });
    lines.push({ x: s.f, y: s.after, cls: 'after' });
    const unit = channel.unit.indexOf('/') > 0 ? '(' + channel.unit + ')' : channel.unit;
    chart(host, { height: 240, title: 'residual spectrum of ' + channel.name, lines: lines,
      levels: s.floor ? [{ at: s.floor, cls: 'floor' }] : [],
      x: { lo: s.f[0], hi: s.f[s.f.length - 1], log: true, label: 'frequency in Hz' },
      y: { lo: lo / 2, hi: hi * 2, log: true, label: unit + '\u00b2/Hz' } });
  }

  // --- residual against states --------------------------------------------------------------
  function against(host) {
    const channel = data.channels.find((c) => c.name === host.dataset.channel);
    const s = data.states[channel.name][Number(host.dataset.index)];
    const both = host.dataset.both === '1';
    let top = 2.2 * (channel.sigma || 0);
    for (const other of data.states[channel.name]) {
      for (const which of both ? ['before', 'after'] : ['after']) {
        other[which].forEach((v, i) => {
          top = Math.max(top, Math.abs(v) + other[which + '_spread'][i]);
        });
      }
    }
    const [k, unit] = scaled(top, channel.unit);
    const band = (which) => ({ x: s.x, cls: 'spread ' + which,
      lo: s[which].map((v, i) => k * (v - s[which + '_spread'][i])),
      hi: s[which].map((v, i) => k * (v + s[which + '_spread'][i])) });
    const line = (which) => ({ x: s.x, y: s[which].map((v) => k * v), cls: 'mean ' + which });
    const which = both ? ['before', 'after'] : ['after'];
    const [kx, ux] = [1, s.unit];
    chart(host, { height: 190, title: 'residual of ' + channel.name + ' against ' + s.axis,
      bands: [{ flat: k * (channel.sigma || 0), cls: 'noise' }].concat(which.map(band)),
      lines: which.map(line),
      x: { lo: kx * s.x[0], hi: kx * s.x[s.x.length - 1], label: s.axis + ' in ' + ux },
      y: { lo: -1.08 * top * k, hi: 1.08 * top * k, label: 'residual in ' + unit } });
  }

  // --- faults of a recording ----------------------------------------------------------------
  function fault(host) {
    const s = data.faults[Number(host.dataset.index)];
    const t = times(s.time), values = decoded(s.values);
    if (!values) return;
    const range = extent([values], 0, values.length);
    const [k, unit] = scaled(Math.max(Math.abs(range[0]), Math.abs(range[1])), s.unit);
    const y = padded([range[0] * k, range[1] * k], 0.12, 1e-9);
    const x = { lo: t[0], hi: t[t.length - 1], label: 'time in s' };
    const least = (x.hi - x.lo) / 150, middle = (s.span[0] + s.span[1]) / 2;
    const half = Math.max(least, s.span[1] - s.span[0]) / 2;
    const a = middle - half, b = middle + half;
    chart(host, { height: 190, title: s.channel + ' around the fault', x: x,
      bands: [{ x: [a, b], lo: [y[0], y[0]], hi: [y[1], y[1]], cls: 'faulty' }],
      lines: [{ x: t, y: times1(values, k), cls: 'raw' }],
      y: { lo: y[0], hi: y[1], label: s.channel + ' in ' + (unit || '1') } });
  }

  function drawAll() {
    document.querySelectorAll('.faultplot').forEach(fault);
    document.querySelectorAll('.spectrum').forEach(spectrum);
    document.querySelectorAll('.against').forEach(against);
  }
  drawAll();
  let timer = null;
  window.addEventListener('resize', () => {
    clearTimeout(timer);
    timer = setTimeout(() => { if (viewer && viewer.redraw) viewer.redraw(); drawAll(); }, 120);
  });
  window.addEventListener('beforeprint', () => {
    document.querySelectorAll('details').forEach((d) => {
      d.dataset.open = d.open ? '1' : '0';
      d.open = true;
    });
  });
  window.addEventListener('afterprint', () => {
    document.querySelectorAll('details').forEach((d) => { d.open = d.dataset.open === '1'; });
  });
})();
