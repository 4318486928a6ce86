// Serve page.html, and hand its questions on to a running `reem browse`: a browser lets a page ask its own server only.
//
//   reem browse --no-open &
//   node serve.mjs http://127.0.0.1:8080 8090        # then open http://127.0.0.1:8090/?path=arm
import { readFileSync } from "node:fs";
import http from "node:http";

const [target = "http://127.0.0.1:8080", port = "8090"] = process.argv.slice(2);
const page = readFileSync(new URL("page.html", import.meta.url));

const server = http.createServer((asked, answer) => {
  if (asked.method === "GET" && asked.url.startsWith("/api/")) {
    // With the headers of the browser: `reem browse` checks by them that no other site asks.
    const passed = http.get(target + asked.url, { headers: asked.headers }, (found) => {
      answer.writeHead(found.statusCode, found.headers);
      found.pipe(answer);
      found.on("error", () => answer.destroy());
    });
    passed.on("error", (error) => {
      if (!answer.headersSent) answer.writeHead(502, { "content-type": "application/json" });
      answer.end(JSON.stringify({ error: `reem browse does not answer at ${target}: ${error.code}` }));
    });
    answer.on("close", () => passed.destroy());
  } else if (asked.method === "GET" && /^\/(\?|$)/.test(asked.url)) {
    answer.writeHead(200, { "content-type": "text/html; charset=utf-8" }).end(page);
  } else {
    answer.writeHead(404).end();
  }
});
server.on("error", (error) => { console.error(`error: ${error.message}`); process.exit(1); });
server.listen(Number(port), "127.0.0.1", () => console.log(`http://127.0.0.1:${server.address().port}/`));
