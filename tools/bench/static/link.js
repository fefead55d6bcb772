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
    this.server = ""; // which server this is: another one has another history, and perhaps another token
    this.refused = false; // whether the server does not know the token
    this.connect();
  }

  connect() {
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/live`);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.connected = true;
      this.log = [];
      this.send({ type: "hello", token: this.token });
      for (const subscription of this.subscriptions.values()) this.ask(subscription);
      if (this.wantsCounts) this.send({ type: "counts", on: true });
      this.emit("connection");
    };
    socket.onmessage = (event) => {
      this.lastMessage = performance.now();
      if (typeof event.data === "string") this.onText(JSON.parse(event.data));
      else this.onBuckets(event.data);
    };
    socket.onclose = (event) => {
      this.connected = false;
      if (event.code === 4403) this.refused = true;
      for (const { resolve, buckets } of this.waiting.values()) resolve(buckets); // empty: nobody answers any more
      this.waiting.clear();
      this.emit("connection");
      setTimeout(() => this.connect(), 500);
    };
    this.socket = socket;
  }

  /** Another token, for a server that was started again; everything else stays as it is. */
  useToken(token) {
    this.token = token;
    this.refused = false;
    this.send({ type: "hello", token });
  }

  emit(name, detail) { this.dispatchEvent(new CustomEvent(name, { detail })); }
  send(message) { if (this.socket.readyState === 1) this.socket.send(JSON.stringify(message)); }

  /** Listen to an event; the answer takes it back. */
  on(name, handler) {
    const listener = (event) => handler(event.detail);
    this.addEventListener(name, listener);
    return () => this.removeEventListener(name, listener);
  }

  /** Follow channels: `rows` newest rows on `pixels` pixels. `subscription.buckets` always holds the newest. */
  subscribe(channels, rows, pixels) {
    const subscription = { id: this.next++, channels, rows, pixels: Math.max(1, Math.round(pixels)), buckets: new Buckets(channels.length) };
    this.subscriptions.set(subscription.id, subscription);
    this.ask(subscription);
    return subscription;
  }

  ask({ id, channels, rows, pixels, buckets }) {
    buckets.clear();
    this.send({ type: "subscribe", id, channels, rows, pixels });
  }

  drop(subscription) {
    if (subscription && this.subscriptions.delete(subscription.id)) this.send({ type: "unsubscribe", id: subscription.id });
  }

  /** A part of the past, once: resolves with Buckets. */
  range(channels, first, stop, pixels) {
    const id = this.next++;
    return new Promise((resolve) => {
      this.waiting.set(id, { resolve, buckets: new Buckets(channels.length) });
      this.send({ type: "range", id, channels, first: Math.max(0, Math.floor(first)), stop: Math.max(0, Math.ceil(stop)), pixels: Math.round(pixels) });
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
      const another = this.server && this.server !== message.server;
      const same = !another && this.run === message.run; // only the connection, or the token, is another one
      [this.server, this.run] = [message.server, message.run];
      this.emit("run", { same });
      if (another) this.emit("server", message.server);
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
