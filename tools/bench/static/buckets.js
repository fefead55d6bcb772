// What a subscription has received: time, smallest and largest value per bucket, oldest first.

export class Buckets {
  constructor(channels) {
    this.channels = channels;
    this.clear();
  }

  clear() {
    this.first = 0; // number of the first bucket kept
    this.n = 0;
    this.perBucket = 1;
    this.capacity = 0;
    this.start = 0;
  }

  reserve(n) {
    if (this.start + n <= this.capacity) return;
    const capacity = Math.max(1024, 2 * n);
    const t = new Float64Array(capacity);
    const low = Array.from({ length: this.channels }, () => new Float32Array(capacity));
    const high = Array.from({ length: this.channels }, () => new Float32Array(capacity));
    if (this.n) {
      const end = this.start + this.n;
      t.set(this.t.subarray(this.start, end));
      for (let c = 0; c < this.channels; c++) {
        low[c].set(this.low[c].subarray(this.start, end));
        high[c].set(this.high[c].subarray(this.start, end));
      }
    }
    Object.assign(this, { t, low, high, capacity, start: 0 });
  }

  /** Add a message; what overlaps is replaced, what is older than `rows` is forgotten. */
  take(data, headerBytes, rows) {
    const view = new DataView(data);
    const channels = view.getUint32(8, true);
    const n = view.getUint32(12, true);
    const perBucket = view.getUint32(16, true);
    const single = view.getUint32(20, true) & 1;
    const first = view.getFloat64(24, true);
    if (channels !== this.channels) return;
    if (perBucket !== this.perBucket || first < this.first || first > this.first + this.n) {
      this.clear();
      this.perBucket = perBucket;
      this.first = first;
    }
    const offset = first - this.first;
    this.reserve(offset + n);
    const at = this.start + offset;
    const t = new Float64Array(data, headerBytes, n);
    const values = new Float32Array(data, headerBytes + 8 * n);
    this.t.set(t, at);
    for (let c = 0; c < channels; c++) {
      const low = values.subarray(c * n, c * n + n);
      this.low[c].set(low, at);
      this.high[c].set(single ? low : values.subarray((channels + c) * n, (channels + c) * n + n), at);
    }
    this.n = Math.max(this.n, offset + n);
    const excess = this.n - (Math.ceil(rows / perBucket) + 1);
    if (Number.isFinite(excess) && excess > 0) {
      this.start += excess;
      this.first += excess;
      this.n -= excess;
    }
  }

  /** Times of all buckets kept. */
  times() { return this.n ? this.t.subarray(this.start, this.start + this.n) : new Float64Array(0); }
  lows(c) { return this.n ? this.low[c].subarray(this.start, this.start + this.n) : new Float32Array(0); }
  highs(c) { return this.n ? this.high[c].subarray(this.start, this.start + this.n) : new Float32Array(0); }
  last(c) { return this.n ? this.high[c][this.start + this.n - 1] : NaN; }
}
