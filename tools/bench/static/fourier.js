// Amplitude spectrum of a window of samples (Hann, radix 2).

/** Amplitudes at i * hz / n for i < n / 2; `n` is the largest power of two that fits, the newest samples are used. */
export function spectrum(samples, hz) {
  const n = 2 ** Math.floor(Math.log2(Math.max(2, samples.length)));
  const re = new Float64Array(n);
  const im = new Float64Array(n);
  const start = samples.length - n;
  let mean = 0;
  for (let i = 0; i < n; i++) mean += samples[start + i] / n;
  for (let i = 0; i < n; i++) re[i] = (samples[start + i] - mean) * (0.5 - 0.5 * Math.cos((2 * Math.PI * i) / n));
  for (let i = 1, j = 0; i < n; i++) {
    let bit = n >> 1;
    for (; j & bit; bit >>= 1) j ^= bit;
    j ^= bit;
    if (i < j) [re[i], re[j]] = [re[j], re[i]];
  }
  for (let size = 2; size <= n; size <<= 1) {
    const angle = (-2 * Math.PI) / size;
    for (let i = 0; i < n; i += size) {
      for (let k = 0; k < size / 2; k++) {
        const [c, s] = [Math.cos(angle * k), Math.sin(angle * k)];
        const a = i + k;
        const b = a + size / 2;
        const [x, y] = [re[b] * c - im[b] * s, re[b] * s + im[b] * c];
        [re[b], im[b]] = [re[a] - x, im[a] - y];
        [re[a], im[a]] = [re[a] + x, im[a] + y];
      }
    }
  }
  const amplitude = new Float64Array(n / 2);
  for (let i = 0; i < n / 2; i++) amplitude[i] = (4 * Math.hypot(re[i], im[i])) / n; // Hann: coherent gain 1/2
  return { amplitude, step: hz / n };
}

/** rms of what a spectrum holds from `low` to below `high` Hz; the mean is not in it. */
export function bandRms({ amplitude, step }, low, high) {
  let sum = 0;
  for (let k = Math.max(1, Math.ceil(low / step)); k < amplitude.length && k * step < high; k++) sum += amplitude[k] ** 2;
  return Math.sqrt(sum / 3); // Hann: mean square of the window 3/8, coherent gain 1/2
}
