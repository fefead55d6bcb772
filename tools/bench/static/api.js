// Requests. What changes something carries the token.

let token = "";
export const setToken = (value) => { token = value; };

async function ask(method, path, body) {
  const isFile = body instanceof Blob;
  const answer = await fetch(path, {
    method,
    headers: { "X-Micron-Token": token, ...(body && !isFile ? { "Content-Type": "application/json" } : {}) },
    body: isFile ? body : body ? JSON.stringify(body) : undefined,
  });
  if (!answer.ok) {
    let reason = `${answer.status}`;
    try { reason = (await answer.json()).error || reason; } catch { /* no JSON: the status says it */ }
    throw new Error(reason);
  }
  return answer;
}

export const get = async (path) => (await ask("GET", path)).json();
export const post = async (path, body = {}) => (await ask("POST", path, body)).json();
export const put = async (path, file) => (await ask("PUT", path, file)).json();
export const blobUrl = async (path) => URL.createObjectURL(await (await ask("GET", path)).blob());

export async function download(path, name) {
  const link = document.createElement("a");
  link.href = await blobUrl(path);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}
