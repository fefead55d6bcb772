// The websocket: one for the page, reconnects by itself, knows how old its data are.
import { Buckets } from "./buckets.js";

const HEADER = 32;

export class Link extends EventTarget {
  constructor(token) {
    super();
    this.token = token;
    this.state = null;
    this.mayOrder = false;
    this.connected = false;
    this.lastMessage = performance.now();
    this.frames = 0;
    this.bytes = 0;
    this.subscriptions = new Map();
    this.waiting = new Map();
    this.next = 1;
    this.log = [];
    this.wantsCounts = false;
    this.run = -1;
    this.replay = null; // the recording that the views show, if they show one
    this.server = ""; // which server this is: another one has another history, and perhaps another token
    this.refused = false; // whether the server does not know the token
    this.wasTrusted = false; // whether a server knew a token of this page
    this.connect();
  }

  connect() {
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/live`);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.connected = true;
      this.log = [];
      this.introduce();
      this.emit("connection");
    };
    socket.onmessage = (event) => {
      this.lastMessage = performance.now();
      if (typeof event.data === "string") this.onText(JSON.parse(event.data));
      else this.onBuckets(event.data);
    };
    socket.onclose = (event) => {
      this.connected = false;
      if (this.replay) this.lostReplay = this.replay;
      if (event.code === 4403) this.refused = true;
      for (const { resolve, buckets } of this.waiting.values()) resolve(buckets); // empty: nobody answers any more
      this.waiting.clear();
      this.emit("connection");
      setTimeout(() => this.connect(), 500);
    };
    this.socket = socket;
  }

  /** The token, and all that this page follows: behind --listen nothing was taken before the token was right. */
  introduce() {
    this.send({ type: "hello", token: this.token });
    if (this.lostReplay) this.reopen(this.lostReplay); // the server keeps it for a connection: at the same place
    for (const subscription of this.subscriptions.values()) this.ask(subscription);
    if (this.wantsCounts) this.send({ type: "counts", on: true });
  }

  /** Another token, for a server that was started again; everything else stays as it is. */
  useToken(token) {
    this.token = token;
    this.introduce(); // the answer says whether it is the right one
  }

  emit(name, detail) { this.dispatchEvent(new CustomEvent(name, { detail })); }
  send(message) { if (this.socket.readyState === 1) this.socket.send(JSON.stringify(message)); }

  /** Listen to an event; the answer takes it back. */
  on(name, handler) {
    const listener = (event) => handler(event.detail);
    this.addEventListener(name, listener);
    return () => this.removeEventListener(name, listener);
  }

  /** Rows a second of what the views show. */
  get rateHz() { return (this.replay || this.state)?.rate_hz ?? 1000; }

  /** Holds of what the views show. */
  get holds() { return this.replay ? this.replay.holds : this.state?.holds; }

  /** Open, move, play or close a replay. */
  replayTo(message) { this.send({ type: "replay", ...message }); }

  reopen({ name, position_s, speed, second, shift_s }) {
    this.replayTo({ name });
    this.replayTo({ speed });
    if (second) this.replayTo({ second });
    if (second && shift_s) this.replayTo({ shift: shift_s });
    this.replayTo({ seek: position_s });
  }

  /** Follow channels: `rows` newest rows on `pixels` pixels. `subscription.buckets` always holds the newest.
   * `source`: what the page shows (0), the run laid over it (1), or the bench itself, whatever is shown (2). */
  subscribe(channels, rows, pixels, source = 0) {
    const subscription = { id: this.next++, channels, rows, pixels: Math.max(1, Math.round(pixels)), buckets: new Buckets(channels.length), source };
    this.subscriptions.set(subscription.id, subscription);
    this.ask(subscription);
    return subscription;
  }

  ask({ id, channels, rows, pixels, buckets, source }) {
    buckets.clear();
    this.send({ type: "subscribe", id, channels, rows, pixels, source });
  }

  drop(subscription) {
    if (subscription && this.subscriptions.delete(subscription.id)) this.send({ type: "unsubscribe", id: subscription.id });
  }

  /** A part of the past, once: resolves with Buckets. */
  range(channels, first, stop, pixels, source = 0) {
    const id = this.next++;
    return new Promise((resolve) => {
      this.waiting.set(id, { resolve, buckets: new Buckets(channels.length) });
      this.send({ type: "range", id, source, channels, first: Math.max(0, Math.floor(first)), stop: Math.max(0, Math.ceil(stop)), pixels: Math.round(pixels) });
    });
  }

  counts(on) {
    this.wantsCounts = on;
    this.send({ type: "counts", on });
  }

  order(order, values = {}) { this.send({ type: "order", order, ...values }); }

  onText(message) {
    if (message.type === "state") {
      this.state = message;
      this.mayOrder = message.may_order;
      this.emit("state", message);
    } else if (message.type === "hello") {
      for (const subscription of this.subscriptions.values()) subscription.buckets.clear();
      this.mayOrder = message.may_order;
      this.refused = Boolean(this.token) && !this.mayOrder;
      this.lostReplay = null;
      this.wasTrusted ||= this.mayOrder;
      const another = this.server && this.server !== message.server;
      const same = !another && this.run === message.run; // only the connection, or the token, is another one
      [this.server, this.run] = [message.server, message.run];
      this.emit("run", { same, instrument: message.instrument });
      if (another) this.emit("server", message.server);
    } else if (message.type === "replay") {
      const began = message.name && this.replay?.name !== message.name;
      this.replay = message.name ? { position_s: 0, playing: false, speed: 1, ...this.replay, ...message } : null;
      if (began || !this.replay) this.emit("source", this.replay);
      this.emit("replay", this.replay);
    } else if (message.type === "place" && this.replay) {
      Object.assign(this.replay, message);
      this.emit("replay", this.replay);
    } else if (message.type === "jump") {
      for (const { buckets, source } of this.subscriptions.values()) if (source !== 2) buckets.clear();
      this.emit("jump");
    } else if (message.type === "replay problem") {
      this.emit("replay problem", message.text);
    } else if (message.type === "game") {
      this.emit("game", message.game);
    } else if (message.type === "shadow") {
      this.shadow = message.q;
    } else if (message.type === "counts") {
      this.emit("counts", message.counts);
    } else if (message.type === "log") {
      this.log.push(...message.lines);
      this.log.splice(0, this.log.length - 500);
      this.emit("log", message.lines);
    }
  }

  onBuckets(data) {
    this.frames += 1;
    this.bytes += data.byteLength;
    const id = new DataView(data).getUint32(4, true);
    const waiting = this.waiting.get(id);
    const subscription = this.subscriptions.get(id);
    if (waiting) {
      this.waiting.delete(id);
      waiting.buckets.take(data, HEADER, Infinity);
      waiting.resolve(waiting.buckets);
    } else if (subscription) {
      subscription.buckets.take(data, HEADER, subscription.rows);
      this.emit("data", subscription);
    }
  }
}
