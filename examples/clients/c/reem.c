// A client of REEM in C with plain sockets. It follows docs/wire.md.
//
//   cc -O2 -o reem reem.c -lm
//   ./reem redis://localhost:6379 get arm.q
//   ./reem redis://localhost:6379 publish arm speed=0.5 mode=auto q=0,0.5,1
//   ./reem redis://localhost:6379 watch arm 10
//   ./reem redis://localhost:6379 call arm.plan goal=2 start=0,0.5
#define _GNU_SOURCE
#include <ctype.h>
#include <errno.h>
#include <math.h>
#include <netdb.h>
#include <poll.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/random.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { LARGEST = 1 << 29, IN_NOTICE = 1 << 14, IN_REQUEST = 1 << 16, MOST = 1000, DEEPEST = 8 };

static void fail(const char *form, ...) {
    char line[512];
    va_list list;
    va_start(list, form);
    vsnprintf(line, sizeof line, form, list);
    for (char *at = line; *at; at++) *at = (unsigned char)*at < 32 ? ' ' : *at;
    fprintf(stderr, "error: %s\n", line);
    exit(1);
}

// Bytes. All of them are freed together, by `forget`.

typedef struct { char *data; size_t size; } Text; // a zero follows the bytes; data is NULL for what is not there

static void *kept[1 << 20];
static size_t kept_count;

static void *keep(void *data) {
    if (data == NULL || kept_count == sizeof kept / sizeof *kept) fail("there is no memory");
    return kept[kept_count++] = data;
}

static Text room(size_t size) {
    Text it = {keep(malloc(size + 1)), size};
    it.data[size] = 0;
    return it;
}

static void forget(void) {
    while (kept_count > 0) free(kept[--kept_count]);
}

static Text text_of(const char *form, ...) {
    va_list list;
    va_start(list, form);
    char *data;
    int size = vasprintf(&data, form, list);
    va_end(list);
    return (Text){keep(size < 0 ? NULL : data), (size_t)size};
}

static Text joined(Text one, Text other) {
    Text both = room(one.size + other.size);
    memcpy(both.data, one.data, one.size);
    memcpy(both.data + one.size, other.data, other.size);
    return both;
}

static int is(Text it, const char *word) { return it.data != NULL && it.size == strlen(word) && !memcmp(it.data, word, it.size); }

static double now(void) {
    struct timespec it;
    clock_gettime(CLOCK_MONOTONIC, &it);
    return it.tv_sec + it.tv_nsec / 1e9;
}

static Text new_id(size_t size) {
    Text id = room(2 * size);
    unsigned char bytes[8];
    if (getrandom(bytes, size, 0) != (ssize_t)size) fail("there are no random numbers");
    for (size_t at = 0; at < size; at++) sprintf(id.data + 2 * at, "%02x", bytes[at]);
    return id;
}

// The connection, with RESP3: replies, and in order with them the messages of channels.

typedef struct Reply {
    char kind;
    long long number; // of items, bytes, or the number itself
    Text text;
    struct Reply *items;
} Reply;

static int connection, has_json = 1;
static Text messages[MOST];    // that are not handled yet; each is freed by itself
static size_t message_count;
static char buffer[1 << 16];
static size_t buffer_at, buffer_end;

static int arrives(double seconds) { // whether there is something to read, or the end of it
    struct pollfd it = {connection, POLLIN, 0};
    return buffer_at < buffer_end || poll(&it, 1, seconds > 0 ? (int)(seconds * 1000) : 0) > 0;
}

static char next_byte(void) {
    if (buffer_at == buffer_end) {
        if (!arrives(5)) fail("the server does not answer");
        ssize_t size = recv(connection, buffer, sizeof buffer, 0);
        if (size <= 0) fail("the server closed the connection");
        buffer_at = 0;
        buffer_end = (size_t)size;
    }
    return buffer[buffer_at++];
}

static Reply next_reply(int depth) {
    char line[512];
    size_t size = 0;
    while (size < 2 || line[size - 2] != '\r' || line[size - 1] != '\n') {
        if (size == sizeof line - 1) fail("the server sent a line without an end");
        line[size++] = next_byte();
    }
    line[size - 2] = 0;
    Reply it = {line[0], 0, text_of("%s", line + (line[0] != 0)), NULL};
    if (depth > DEEPEST || !it.kind || !strchr("+-:_,#$=*~>%", it.kind)) fail("the server sent '%.40s', which is no reply", line);
    if (strchr("+-,#_", it.kind)) {
        if (it.kind == '_') it.text.data = NULL;
        return it;
    }
    char *end;
    it.number = strtoll(line + 1, &end, 10);
    if (*end || end == line + 1) fail("the server sent '%.40s', which is no number", line);
    if (it.kind == ':') return it;
    if (it.number == -1) return (Reply){'_', 0, {NULL, 0}, NULL};
    if (it.number < 0 || it.number > LARGEST) fail("the server sent a reply of %lld bytes or items", it.number);
    if (it.kind == '$' || it.kind == '=') {
        it.text = room((size_t)it.number);
        for (long long at = 0; at < it.number; at++) it.text.data[at] = next_byte();
        if (next_byte() != '\r' || next_byte() != '\n') fail("the server sent a text of another length than it said");
        return it;
    }
    it.number *= it.kind == '%' ? 2 : 1;
    for (long long at = 0; at < it.number; at++) { // room as they come: a server may announce any number
        Reply item = next_reply(depth + 1);
        if ((at & (at + 1)) == 0 && !(it.items = realloc(it.items, 2 * (size_t)(at + 1) * sizeof item))) fail("no memory");
        it.items[at] = item;
    }
    if (it.items != NULL) keep(it.items);
    return it;
}

static Reply next_frame(void) {
    Reply it = next_reply(0);
    if (it.kind == '>' && it.number == 3 && is(it.items[0].text, "message") && it.items[2].text.data) {
        if (message_count == MOST) fail("there are more than %d messages that wait", MOST);
        Text payload = it.items[2].text, copy = {malloc(payload.size + 1), payload.size};
        if (copy.data == NULL) fail("there is no memory");
        memcpy(copy.data, payload.data, payload.size + 1);
        messages[message_count++] = copy;
    }
    return it;
}

static Reply sent(const Text *words, size_t count, int is_tried) {
    Text all = text_of("*%zu\r\n", count);
    for (size_t at = 0; at < count; at++) {
        all = joined(joined(all, text_of("$%zu\r\n", words[at].size)), joined(words[at], text_of("\r\n")));
    }
    for (size_t at = 0; at < all.size;) {
        ssize_t size = send(connection, all.data + at, all.size - at, MSG_NOSIGNAL);
        if (size <= 0) fail("the connection broke: %s", strerror(errno));
        at += (size_t)size;
    }
    for (;;) {
        Reply it = next_frame();
        if (it.kind == '-' && !is_tried) fail("the server refused %s: %s", words[0].data, it.text.data);
        if (it.kind != '>' || (it.number > 0 && is(it.items[0].text, "subscribe"))) return it;
    }
}

// Send a command of words that are Texts, and return its reply.
#define SEND(...) sent((Text[]){__VA_ARGS__}, sizeof((Text[]){__VA_ARGS__}) / sizeof(Text), 0)
#define T(...) text_of(__VA_ARGS__)

static Reply list(Reply it) {
    if (!strchr("*~", it.kind)) fail("the server sent another reply than a list");
    return it;
}

// Return the next message, or nothing if there is none for so long.
static Text wait_for(double seconds) {
    if (message_count == 0 && arrives(seconds) && next_frame().kind != '>') fail("the server sent a reply to no command");
    if (message_count == 0) return (Text){NULL, 0};
    Text first = messages[0], copy = room(first.size);
    memcpy(copy.data, first.data, first.size);
    free(first.data);
    memmove(messages, messages + 1, --message_count * sizeof *messages);
    return copy;
}

static void open_connection(const char *url) {
    char user[256] = "default", password[256] = "", host[256] = "", port[8] = "6379";
    const char *rest = strncmp(url, "redis://", 8) ? "" : url + 8, *at = strrchr(rest, '@');
    if (at != NULL && sscanf(rest, ":%255[^@]", password) != 1) sscanf(rest, "%255[^:@]:%255[^@]", user, password);
    sscanf(at ? at + 1 : rest, "%255[^:/]", host);
    const char *behind_port = (at ? at + 1 : rest) + strlen(host);
    if (sscanf(behind_port, ":%7[0-9]", port) == 1) behind_port += 1 + strlen(port);
    if (*behind_port && strcmp(behind_port, "/") && strcmp(behind_port, "/0")) host[0] = 0;
    struct addrinfo hints = {.ai_socktype = SOCK_STREAM}, *found;
    if (!host[0]) fail("the URL is not like redis://[user:password@]host[:port]");
    if (getaddrinfo(host, port, &hints, &found) != 0) fail("there is no host %s", host);
    for (connection = -1; found != NULL && connection < 0; found = found->ai_next) {
        connection = socket(found->ai_family, SOCK_STREAM, 0);
        if (connect(connection, found->ai_addr, found->ai_addrlen) == 0) break;
        close(connection);
        connection = -1;
    }
    if (connection < 0) fail("no server answers at %s:%s: %s", host, port, strerror(errno));
    Reply hello = password[0] ? SEND(T("HELLO"), T("3"), T("AUTH"), T("%s", user), T("%s", password)) : SEND(T("HELLO"), T("3"));
    for (long long item = 1; item < hello.number; item++) {
        int is_mode = is(hello.items[item - 1].text, "mode") && !is(hello.items[item].text, "standalone");
        if (is_mode) fail("this is not a single server, but: %s", hello.items[item].text.data);
    }
    Text words[] = {T("JSON.TYPE"), T("_")};
    Reply kind = sent(words, 2, 1); // a server without the JSON module holds documents as text
    has_json = kind.kind != '-';
    if (!has_json && strncmp(kind.text.data, "ERR unknown command", 19)) fail("the server refused JSON.TYPE: %s", kind.text.data);
}

// Documents: the text of JSON is never turned into a tree. A value is the part of the text that holds it.

static const char *blank(const char *at, const char *end) {
    while (at < end && strchr(" \t\r\n", *at)) at++;
    return at;
}

static const char *behind_string(const char *at, const char *end) {
    for (at++; at < end && *at != '"'; at++) at += *at == '\\';
    return at < end ? at + 1 : NULL;
}

// Return what is behind the value at a place, NULL if the text ends before.
static const char *behind(const char *at, const char *end) {
    for (int depth = 0;;) {
        if ((at = blank(at, end)) >= end) return NULL;
        if (*at == '"') at = behind_string(at, end);
        else if (strchr("{[", *at)) depth++, at++;
        else if (strchr("}]", *at)) depth--, at++;
        else if (strchr(",:", *at)) at++;
        else {
            size_t size = strcspn(at, " \t\r\n{}[],:\""), digits = strspn(at, "0123456789+-.eE");
            if (digits != size && strncmp(at, "true", size) && strncmp(at, "false", size) && strncmp(at, "null", size)) return NULL;
            at += size;
        }
        if (at == NULL || depth <= 0) return depth < 0 ? NULL : at;
    }
}

// Return an item of a list, or the value of a key that is written without escapes; nothing if there is none.
static Text inside(Text json, const char *key) {
    const char *end = json.data + json.size, *at = json.data ? blank(json.data, end) : end;
    int is_list = at < end && *at == '[';
    if (at == end || (!is_list && *at != '{')) return (Text){NULL, 0};
    at = blank(at + 1, end);
    for (long item = 0; at < end && !strchr("]}", *at); item++) {
        int found = is_list && isdigit((unsigned char)*key) && strtol(key, NULL, 10) == item;
        if (!is_list) {
            const char *name = at;
            if (*at != '"' || (at = behind_string(at, end)) == NULL) return (Text){NULL, 0};
            found = strlen(key) == (size_t)(at - name) - 2 && !memcmp(name + 1, key, strlen(key));
            at = blank(at, end);
            at = at < end && *at == ':' ? blank(at + 1, end) : end;
        }
        const char *from = at;
        if ((at = behind(at, end)) == NULL) return (Text){NULL, 0};
        if (found) return (Text){text_of("%.*s", (int)(at - from), from).data, (size_t)(at - from)};
        at = blank(at, end);
        if (at < end && *at == ',') at = blank(at + 1, end);
    }
    return (Text){NULL, 0};
}

static Text word(Text json, int item) { // a string in a list, without its quotes
    Text it = inside(json, text_of("%d", item).data);
    if (it.size < 2 || it.data[0] != '"') return (Text){NULL, 0};
    return text_of("%.*s", (int)it.size - 2, it.data + 1);
}

static double number(Text json, int item) {
    Text it = inside(json, text_of("%d", item).data);
    char *end;
    double found = it.data ? strtod(it.data, &end) : -1;
    return it.data && it.size && *end == 0 && found >= 0 && found < 9007199254740992.0 ? found : -1;
}

// Arrays.

static void print_item(const unsigned char *bytes, char kind, int size, int is_big, FILE *out) {
    unsigned char little[8] = {0};
    for (int at = 0; at < size; at++) little[at] = bytes[is_big ? size - 1 - at : at];
    uint64_t whole;
    memcpy(&whole, little, 8);
    float narrow;
    double wide;
    memcpy(&narrow, little, sizeof narrow);
    memcpy(&wide, little, sizeof wide);
    if (size == 4) wide = narrow;
    if (kind == 'b') fputs(whole ? "true" : "false", out);
    else if (kind == 'u') fprintf(out, "%llu", (unsigned long long)whole);
    else if (kind == 'i') fprintf(out, "%lld", (long long)(whole << (64 - 8 * size)) >> (64 - 8 * size));
    else if (isfinite(wide)) fprintf(out, "%.17g", wide);
    else fputs(isnan(wide) ? "NaN" : wide > 0 ? "Infinity" : "-Infinity", out);
}

static void print_array(Text blob, const char *where, FILE *out) {
    char order, kind, size, shape[256] = "", expected[] = "\x93NUMPY\x01";
    if (blob.data == NULL) fail("%s: the array is gone from the server", where);
    size_t start = blob.size > 10 ? 10 + (unsigned char)blob.data[8] + 256 * (unsigned char)blob.data[9] : 0;
    if (start == 0 || start > blob.size || memcmp(blob.data, expected, sizeof expected)) fail("%s: this is no array", where);
    char *header = text_of("%.*s", (int)(start - 10), blob.data + 10).data;
    const char *form = "{'descr': '%c%c%c', 'fortran_order': False, 'shape': (%255[0-9, ]";
    int fields = sscanf(header, form, &order, &kind, &size, shape);
    int is_known = fields >= 3 && strchr("<>|", order) && strchr(kind == 'f' ? "48" : kind == 'b' ? "1" : "1248", size);
    if (!is_known || !strchr("biuf", kind)) fail("%s: this client cannot read an array %.80s", where, header);
    double count = 1, dimensions[64];
    int rank = 0;
    for (char *at = shape; *at && rank < 64; at += strspn(at, ", ")) count *= dimensions[rank++] = strtod(at, &at);
    if (count * (size - '0') != (double)(blob.size - start)) fail("%s: the array has a wrong size", where);
    fprintf(out, "{\"dtype\":\"%c%c%c\",\"shape\":[", order, kind, size);
    for (int at = 0; at < rank; at++) fprintf(out, "%s%.0f", at ? "," : "", dimensions[at]);
    fputs("],\"data\":[", out);
    for (size_t at = start; at < blob.size; at += (size_t)(size - '0')) {
        if (at > start) fputc(',', out);
        print_item((unsigned char *)blob.data + at, kind, size - '0', order == '>', out);
    }
    fputs("]}", out);
}

// Print a value, with its arrays in the order of their placeholders; without `out` only collect their suffixes.
static size_t render(Text json, const char *where, Text *suffixes, const Text *blobs, FILE *out) {
    size_t count = 0;
    const char *end = json.data + json.size;
    for (const char *at = json.data; at < end;) {
        const char *from = at;
        if (*at != '"') {
            if (out) fputc(*at, out);
            at++;
            continue;
        }
        if ((at = behind_string(at, end)) == NULL) fail("%s: this is no JSON", where);
        const char *next = blank(at, end);
        int is_key = next < end && *next == ':', size = (int)(at - from) - 2;
        if (is_key || size < 6 || memcmp(from + 1, "$ship ", 6)) {
            if (out) fwrite(from, 1, (size_t)(at - from), out);
            continue;
        }
        Text rest = text_of("%.*s", size - 6, from + 7);
        if (!strncmp(rest.data, "text ", 5)) {
            if (out) fprintf(out, "\"%s\"", rest.data + 5);
        } else if (!strncmp(rest.data, "float ", 6)) {
            char *behind_it;
            double found = strtod(rest.data + 6, &behind_it);
            if (*behind_it || behind_it == rest.data + 6 || !isfinite(found)) fail("%s: '%.40s' is no float", where, rest.data);
            if (out) fprintf(out, "%.17g", found);
        } else {
            char label[32] = "", suffix[512] = "";
            if (sscanf(rest.data, "%31s %511s", label, suffix) < 1 || strcmp(label, "numpy")) {
                fail("%s: this client cannot read a value of the kind '%s'", where, label);
            }
            if (count == MOST || strchr(suffix, '%')) fail("%s: this client reads %d arrays with plain names", where, MOST);
            if (!out) suffixes[count] = text_of("%s", suffix);
            for (size_t other = 0; !out && other < count; other++) {
                if (is(suffixes[other], suffix)) fail("%s: two places have the same array", where);
            }
            if (out) print_array(blobs[count], text_of("%s%s", where, suffix).data, out);
            count++;
        }
    }
    return count;
}

static void print_value(Text json, const char *where, const Text *blobs, const char *before, const char *after) {
    char *data;
    size_t size;
    FILE *out = open_memstream(&data, &size); // all of it or, after an error, nothing
    fputs(before, out);
    if (json.data == NULL) fputs("null", out);
    else render(json, where, NULL, blobs, out);
    fputs(after, out);
    fclose(out);
    fwrite(data, 1, size, stdout);
    fputc('\n', stdout);
    fflush(stdout);
    free(data);
}

static Text quoted(const char *text) {
    Text json = room(6 * strlen(text) + 2);
    char *at = json.data;
    *at++ = '"';
    for (; *text; text++) {
        if (strchr("\"\\", *text)) at += sprintf(at, "\\%c", *text);
        else if ((unsigned char)*text < 32) at += sprintf(at, "\\u%04x", *text);
        else *at++ = *text;
    }
    strcpy(at, "\"");
    return (Text){json.data, (size_t)(at - json.data) + 1};
}

// Return the JSON of a number, exact on each server: long floats are hexadecimal. Nothing for what is no number.
static Text number_text(const char *text) {
    char *end, shorter[32];
    double value = strtod(text, &end);
    if (*text == 0 || *end || text[strspn(text, "0123456789+-.eE")]) return (Text){NULL, 0};
    if (!text[strspn(text, "-0123456789")]) {
        if (strlen(text) > 18) fail("%s: this client sends integers of up to 17 digits", text);
        return text_of("%lld", strtoll(text, NULL, 10));
    }
    if (!isfinite(value)) fail("%s is no number of JSON", text);
    snprintf(shorter, sizeof shorter, "%.15g", value);
    if (strtod(shorter, NULL) != value || strchr(shorter, 'e') || strlen(shorter) > 16) return text_of("\"$ship float %a\"", value);
    return text_of("%s%s", shorter, strchr(shorter, '.') ? "" : ".0");
}

typedef struct { Text text, parts, body, suffixes[64], blobs[64]; size_t count; } Encoded;

// Return a document for words such as `speed=0.5` and `q=0,0.5`, with its arrays: in `body` they follow the text.
static Encoded encoded(char **words, int count, const char *above) {
    Encoded it = {text_of("{"), text_of("["), {NULL, 0}, {{NULL, 0}}, {{NULL, 0}}, 0};
    Text data = text_of("%s", "");
    for (int at = 0; at < count; at++) {
        char *sign = strchr(words[at], '='), *name = sign ? text_of("%.*s", (int)(sign - words[at]), words[at]).data : "";
        if (!*name || name[strcspn(name, ".[]\"'\\~% ")]) fail("'%s' is not like name=value", words[at]);
        Text value = strchr(sign + 1, ',') ? (Text){NULL, 0} : number_text(sign + 1);
        double *items = (double *)room(8 * strlen(sign)).data;
        size_t size = 0;
        char *from = sign + 1, *end = from;
        for (; !value.data && *from && !from[strspn(from, "0123456789+-.eE,")]; from = *end == ',' ? end + 1 : end, size++) {
            items[size] = strtod(from, &end);
            if (end == from || (*end && *end != ',')) break;
        }
        if (!value.data && size && !*from) {
            if (it.count == 64) fail("this client sends up to 64 arrays");
            Text header = text_of("{'descr': '<f8', 'fortran_order': False, 'shape': (%zu,), }", size);
            int length = 64 * (int)((header.size + 11 + 63) / 64) - 10;
            header = text_of("%-*s\n", length - 1, header.data);
            Text start = text_of("\x93NUMPY\x01%c%c%c", 0, length & 255, length >> 8); // numbers are little-endian here
            it.suffixes[it.count] = text_of("%s.%s", above, name);
            it.blobs[it.count] = joined(joined(start, header), (Text){(char *)items, 8 * size});
            it.parts = text_of("%s%s[\"numpy\",%s,%zu]", it.parts.data, it.count ? "," : "",
                               quoted(it.suffixes[it.count].data).data, it.blobs[it.count].size);
            data = joined(data, it.blobs[it.count]);
            value = quoted(text_of("$ship numpy %s %zu float64[%zu]", it.suffixes[it.count++].data, 8 * size, size).data);
        }
        if (!value.data) value = quoted(text_of("%s%s", strncmp(sign + 1, "$ship ", 6) ? "" : "$ship text ", sign + 1).data);
        it.text = text_of("%s%s%s:%s", it.text.data, at ? "," : "", quoted(name).data, value.data);
    }
    it.text = text_of("%s}", it.text.data);
    it.parts = text_of("%s]", it.parts.data);
    it.body = joined(it.text, data);
    return it;
}

// What a program does. A place such as `arm.joints.0` has names of letters, digits and the like, and indexes.

typedef struct { const char *all; char *key, *steps[256], suffix[1024]; int count; } Place; // a text of 500 bytes has no more

static Place place_of(const char *text) {
    Place it = {.all = text, .key = strdup(text), .suffix = ""};
    char *at = strchr(it.key, '.');
    if (!*text || text[strcspn(text, "[]{}\"'\\~%*?^ ")] || strlen(text) > 500) fail("'%s' is not like arm.joints.0", text);
    while (at != NULL) {
        *at++ = 0;
        it.steps[it.count] = at;
        if ((at = strchr(at, '.')) != NULL) *at = 0;
        char *step = it.steps[it.count++];
        if (!*step) fail("'%s' is not like arm.joints.0", text);
        int is_index = *step && !step[strspn(step, "0123456789")];
        strcat(strcat(strcat(it.suffix, is_index ? "[" : "."), step), is_index ? "]" : "");
    }
    return it;
}

static Text tagged(const Place *place, const char *end) { return text_of("{%s}%s", place->key, end); }

// Return the JSON at a place and its arrays, all of one instant; nothing if nothing is stored there.
static Text read_value(const Place *place, Text *blobs) {
    Text key = text_of("%s", place->key), jsonpath = text_of("$"), suffixes[MOST];
    for (int at = 0; at < place->count; at++) {
        int is_index = isdigit((unsigned char)place->steps[at][0]) && !place->steps[at][strspn(place->steps[at], "0123456789")];
        jsonpath = text_of("%s[%s]", jsonpath.data, is_index ? place->steps[at] : quoted(place->steps[at]).data);
    }
    for (int attempt = 0; attempt < 100; attempt++) {
        SEND(T("WATCH"), key);
        Text json = has_json ? SEND(T("JSON.GET"), key, jsonpath).text : SEND(T("GET"), key).text;
        if (json.data && !has_json && json.data[0] != ' ') fail("%s is a key of another program", key.data);
        if (json.data && strlen(json.data) != json.size) fail("%s: this is no JSON", key.data);
        if (json.data && !has_json) json = (Text){json.data + 1, json.size - 1};
        if (has_json) json = inside(json, "0");
        else for (int at = 0; at < place->count; at++) json = inside(json, place->steps[at]);
        const char *end = json.data ? behind(json.data, json.data + json.size) : NULL;
        if (json.data && (end == NULL || blank(end, json.data + json.size) < json.data + json.size)) fail("%s: this is no JSON", key.data);
        size_t count = json.data ? render(json, place->all, suffixes, NULL, NULL) : 0;
        SEND(T("MULTI"));
        for (size_t at = 0; at < count; at++) SEND(T("GET"), tagged(place, suffixes[at].data));
        Reply found = SEND(T("EXEC")); // nothing if the document was written since: each write of an array writes it too
        if (found.kind == '_') continue;
        if ((size_t)list(found).number != count) fail("the server sent another reply than a list of %zu", count);
        for (size_t at = 0; at < count; at++) blobs[at] = found.items[at].kind == '$' ? found.items[at].text : (Text){NULL, 0};
        return json;
    }
    fail("%s was written all the time while it was read", place->all);
    return key;
}

// Replace a top-level key and notify its subscribers, in one transaction. Again if another client was faster.
static void publish(const Place *place, char **words, int count) {
    if (place->count) fail("publish a whole top-level key, such as arm");
    Text key = text_of("%s", place->key), ships = tagged(place, ":ships"), lease = tagged(place, ":lease");
    Text publisher = new_id(6); // a program that publishes more keeps it, and counts on for each key
    Encoded it = encoded(words, count, "");
    struct timespec moment;
    clock_gettime(CLOCK_REALTIME, &moment);
    int is_small = it.body.size <= IN_NOTICE;
    Text notice = text_of("[1,\"%s\",1,%ld.%06ld,[],\"%s\",%zu,%s]\n", publisher.data, (long)moment.tv_sec,
                          moment.tv_nsec / 1000, is_small ? "set" : "look", is_small ? it.text.size : it.body.size,
                          is_small ? it.parts.data : "[]");
    if (is_small) notice = joined(notice, it.body);
    for (int attempt = 0; attempt < 100; attempt++) {
        SEND(T("WATCH"), key, ships, lease);
        Text kind = SEND(T("TYPE"), key).text;
        int is_text = !has_json && is(kind, "string") && is(SEND(T("GETRANGE"), key, T("0"), T("0")).text, " ");
        if (!is(kind, "none") && !(has_json && is(kind, "ReJSON-RL")) && !is_text) fail("%s is a key of another program", key.data);
        if (SEND(T("GET"), lease).kind != '_') fail("%s is owned by another program", key.data);
        Reply old = list(SEND(T("SMEMBERS"), ships));
        SEND(T("MULTI"));
        for (long long at = 0; at < old.number; at++) SEND(T("UNLINK"), joined(tagged(place, ""), old.items[at].text));
        SEND(T("UNLINK"), ships);
        for (size_t at = 0; at < it.count; at++) {
            SEND(T("SET"), tagged(place, it.suffixes[at].data), it.blobs[at]);
            SEND(T("SADD"), ships, it.suffixes[at]);
        }
        if (has_json) SEND(T("JSON.SET"), key, T("$"), it.text);
        else SEND(T("SET"), key, joined(T(" "), it.text), T("KEEPTTL"));
        SEND(T("SET"), tagged(place, ":last"), T("%s 1", publisher.data), T("EX"), T("60"));
        SEND(T("PUBLISH"), tagged(place, ":notices"), notice);
        Reply replies = SEND(T("EXEC"));
        if (replies.kind == '_') continue;
        for (long long at = 0; at < list(replies).number; at++) {
            if (replies.items[at].kind == '-') fail("the server refused a part: %s", replies.items[at].text.data);
        }
        return;
    }
    fail("%s was written all the time by another client", key.data);
}

// Return the line of a message of so many fields, and set what is behind it.
static Text line_of(Text payload, int fields, const Place *place, Text *data) {
    char *end = payload.data ? memchr(payload.data, '\n', payload.size) : NULL;
    Text line = {payload.data, end ? (size_t)(end - payload.data) : 0};
    if (!end || !inside(line, text_of("%d", fields - 1).data).data) fail("%s: a message is not of REEM", place->all);
    *end = 0;
    if (number(line, 0) != 1) fail("%s: a message has version %s; this client knows 1", place->all, inside(line, "0").data);
    *data = (Text){end + 1, payload.size - line.size - 1};
    return line;
}

// Print the value of a message: a text of so many bytes and its arrays, which follow it.
static void print_carried(Text data, double size, Text parts, const Place *place, const char *before, const char *after) {
    Text suffixes[MOST], blobs[MOST];
    if (size < 0 || size > (double)data.size) fail("%s: a message has another size than it says", place->all);
    Text json = text_of("%.*s", (int)size, data.data);
    if (behind(json.data, json.data + json.size) != json.data + json.size) fail("%s: this is no JSON", place->all);
    size_t count = render(json, place->all, suffixes, NULL, NULL), start = (size_t)size;
    for (size_t at = 0; at < count; at++) blobs[at] = (Text){NULL, 0};
    Text part;
    for (int index = 0; (part = inside(parts, text_of("%d", index).data)).data; index++) {
        double length = number(part, 2);
        if (length < 0 || start + length > data.size) fail("%s: an array is cut off", place->all);
        for (size_t at = 0; at < count; at++) {
            if (is(word(part, 1), suffixes[at].data)) blobs[at] = (Text){data.data + start, (size_t)length};
        }
        start += (size_t)length;
    }
    if (start != data.size) fail("%s: a message has another size than it says", place->all);
    print_value(json, place->key, blobs, before, after);
}

static struct { char id[65]; double number; } known[MOST]; // the last update of each publisher
static int known_count;

// Return how many updates of a publisher are missing before this one; -1 if its number goes back.
static double missing(const char *publisher, double update) {
    int at = 0;
    while (at < known_count && strcmp(known[at].id, publisher)) at++;
    if (at == MOST) at = known_count = 0; // a stranger has made up that many
    double last = at < known_count ? known[at].number : update - 1;
    if (at == known_count) known_count++;
    snprintf(known[at].id, sizeof known[at].id, "%s", publisher);
    known[at].number = update;
    return update > last ? update - last - 1 : -1;
}

static double last_known(const char *publisher) {
    for (int at = 0; at < known_count; at++) if (!strcmp(known[at].id, publisher)) return known[at].number;
    return 0;
}

static double missing_before(Text line) {
    if (word(line, 1).data == NULL || number(line, 2) < 1) fail("a notice has no publisher or number");
    return missing(word(line, 1).data, number(line, 2));
}

// Print the value, then each update. After a gap, and if a notice has no value, print the value again.
static void watch(const Place *place, long most) {
    Text data, blobs[MOST];
    char publisher[65] = "", note_of[65];
    double lost = 0, probe = now() + 1, update, noted = 0;
    int is_stale = 1, is_noted = 0;
    if (place->count) fail("watch a whole top-level key, such as arm");
    SEND(T("SUBSCRIBE"), tagged(place, ":notices"));
    Reply note = SEND(T("GET"), tagged(place, ":last"));
    if (note.text.data && sscanf(note.text.data, "%64s %lf", publisher, &update) == 2) missing(publisher, update);
    for (; most > 0; forget()) {
        if (is_stale) {
            Text value = read_value(place, blobs);
            while (message_count) { // what arrived before the reply is in it
                double more = missing_before(line_of(wait_for(0), 8, place, &data));
                lost = more < 0 || lost < 0 ? -1 : lost + more;
            }
            Text count = lost < 0 ? text_of("null") : text_of("%.0f", lost);
            const char *before = T("{\"kind\":\"read\",\"lost\":%s,\"path\":[],\"value\":", count.data).data;
            print_value(value, place->key, blobs, before, "}");
            is_stale = is_noted = 0, lost = 0, most--;
            continue;
        }
        Text payload = wait_for(probe - now());
        if (payload.data) {
            Text line = line_of(payload, 8, place, &data), kind = word(line, 5);
            lost = missing_before(line);
            if (!is(kind, "set") && !is(kind, "look") && !is(kind, "delete")) fail("%s: a notice is of no kind", place->all);
            if (lost != 0 || is(kind, "look")) is_stale = 1;
            else {
                const char *before = T("{\"kind\":\"%s\",\"lost\":0,\"path\":%s,\"value\":", kind.data, inside(line, "4").data).data;
                if (is(kind, "set")) print_carried(data, number(line, 6), inside(line, "7"), place, before, "}");
                else print_value((Text){NULL, 0}, place->key, NULL, before, "}");
                most--;
            }
        }
        if (now() >= probe) { // the note names the last update: it must have arrived before the note
            note = SEND(T("GET"), tagged(place, ":last"));
            is_noted = note.text.data && sscanf(note.text.data, "%64s %lf", note_of, &noted) == 2;
            probe = now() + 1;
        }
        if (is_noted && message_count == 0) {
            if (last_known(note_of) < noted) missing(note_of, noted), is_stale = 1, lost = -1;
            is_noted = 0;
        }
    }
}

// Print the answer of one server of a service. Only a request that was not begun goes to another server.
static void call(const Place *place, char **words, int count, double seconds) {
    Text me = new_id(8), id = new_id(8), data, channels = text_of("%s", place->suffix);
    Encoded it = encoded(words, count, place->suffix);
    double end = now() + seconds;
    if (it.body.size > IN_REQUEST) fail("this client sends up to %d bytes of arguments", IN_REQUEST);
    SEND(T("SUBSCRIBE"), tagged(place, T(":answers@%s", me.data).data));
    for (char *at = channels.data; (at = strpbrk(at, "[]")) != NULL;) *at++ = '?'; // brackets are special in patterns
    channels = tagged(place, T("%s:serve@????????????????", channels.data).data);
    Reply found = list(SEND(T("PUBSUB"), T("CHANNELS"), channels));
    for (long long at = 0; at < found.number; at++) {
        Text server = found.items[at].text, line, kind;
        if (server.size < 16) fail("the server sent another reply than channels");
        Text head = T("[1,\"call\",\"%s\",\"%s\",%.3f,[\"\",\"\"],\"here\",%zu,%s]\n", id.data, me.data, fmax(end - now(), 0),
                      it.text.size, it.parts.data);
        if (!SEND(T("PUBLISH"), server, joined(head, it.body)).number) continue; // it has ended
        for (line = (Text){NULL, 0}; !is(word(line, 3), server.data + server.size - 16) || !is(word(line, 2), id.data);) {
            Text payload = wait_for(end - now());
            if (payload.data != NULL) line = line_of(payload, 9, place, &data);
            else if (now() >= end) {
                SEND(T("PUBLISH"), server, T("[1,\"cancel\",\"%s\",\"%s\",0,[],\"\",0,[]]\n", id.data, me.data));
                fail("%s: no answer in time; the request may or may not have been handled", place->all);
            }
        }
        kind = word(line, 1);
        if (is(kind, "busy") || is(kind, "closed")) continue;
        if (!is(kind, "answer")) fail("%s: the service raised %s", place->all, inside(line, "5").data);
        if (!is(word(line, 6), "here")) fail("%s: the answer has over 64 KB, which this client does not read", place->all);
        print_carried(data, number(line, 7), inside(line, "8"), place, "", "");
        return;
    }
    fail("%s: no program serves this, or all are busy", place->all);
}

int main(int count, char **words) {
    if (count < 4) fail("usage: reem URL get|publish|watch|call PLACE [NAME=VALUE ... | COUNT]");
    Place place = place_of(words[3]);
    const char *action = words[2];
    open_connection(words[1]);
    if (!strcmp(action, "publish")) publish(&place, words + 4, count - 4);
    else if (!strcmp(action, "watch")) watch(&place, count > 4 ? atol(words[4]) : INT32_MAX);
    else if (!strcmp(action, "call")) call(&place, words + 4, count - 4, 10);
    else if (!strcmp(action, "get")) {
        Text blobs[MOST], value = read_value(&place, blobs);
        if (value.data == NULL) fail("nothing is stored at %s", words[3]);
        print_value(value, place.key, blobs, "", "");
    } else fail("%s is none of get, publish, watch and call", action);
    return 0;
}
