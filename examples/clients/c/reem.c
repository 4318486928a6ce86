// A client of REEM in C with plain sockets, for a server with the JSON module, by docs/wire.md. cc -O2 -o reem reem.c
//   ./reem redis://localhost:6379 get arm.q
//   ./reem redis://localhost:6379 publish arm '{"speed":0.5}'
//   ./reem redis://localhost:6379 watch arm.q 10
//   ./reem redis://localhost:6379 call arm.plan '{"goal":2}'
#include <err.h>
#include <netdb.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/random.h>
#include <sys/time.h>
#include <time.h>

#define check(ok, ...) do { if (!(ok)) errx(1, __VA_ARGS__); } while (0)
typedef struct { char *data; long size; } Text; // a zero follows the bytes; data is NULL for nothing
static FILE *in, *out;                          // the connection for commands
static char key[128], path[128];                // of the place: arm, .joints[0]
static unsigned long long ids[2];               // random: of this program, of its call

// Send what was written, read lines of these kinds ($ and * have a size, : a number), and return the last number.
static long next_lines(FILE *from, const char *kinds) {
    char line[256] = "";
    for (fflush(out); *kinds; kinds++) {
        check(fgets(line, sizeof line, from), "the server closed the connection, or does not answer");
        line[strcspn(line, "\r\n")] = 0;
        check(*line != '-', "the server refused: %s", line + 1);
        int is_number = line[1] && !line[1 + strspn(line + 1, "-0123456789")];
        check(*line == *kinds && (is_number || !strchr("$*:", *line)), "the server sent another reply than expected");
    }
    return atol(line + 1);
}

static Text next_text(FILE *from) {
    long size = next_lines(from, "$");
    if (size == -1) return (Text){NULL, 0};
    check(size >= 0 && size < 1 << 24, "the server sent a text of %ld bytes", size);
    Text it = {calloc(1, size + 2), size};
    check(it.data && fread(it.data, 1, size + 2, from) && it.data[size] == '\r', "the server sent half a text");
    it.data[size] = 0;
    return it;
}

static void write_publish(const char *channel, const char *text) { // as a list of sized words, since the text has lines
    fprintf(out, "*3\r\n$7\r\nPUBLISH\r\n$%zu\r\n{%s}%s\r\n", strlen(key) + 2 + strlen(channel), key, channel);
    fprintf(out, "$%zu\r\n%s\r\n", strlen(text), text);
}

static FILE *connect_to(const char *url, int seconds) {
    char host[256], port[8] = "6379";
    int end = 0, connection = socket(AF_INET, SOCK_STREAM, 0);
    struct addrinfo hints = {.ai_family = AF_INET, .ai_socktype = SOCK_STREAM}, *found;
    sscanf(url, "redis://%255[^:/@]%n:%7[0-9]%n", host, &end, port, &end);
    check(end && !url[end], "the URL is not like redis://host:port");
    check(!getaddrinfo(host, port, &hints, &found), "no host %s", host);
    check(!connect(connection, found->ai_addr, found->ai_addrlen), "no server answers at %s:%s", host, port);
    setsockopt(connection, SOL_SOCKET, SO_RCVTIMEO, &(struct timeval){seconds, 0}, sizeof(struct timeval));
    return fdopen(connection, "r");
}

static FILE *subscribe(const char *url, const char *channel, int seconds) { // messages have a connection of their own
    FILE *messages = connect_to(url, seconds);
    dprintf(fileno(messages), "SUBSCRIBE {%s}:%s\r\n", key, channel);
    next_lines(messages, "*$s${:"); // a list of the word subscribe, the channel, and a number
    return messages;
}

// Print an .npy file: ten bytes, of which the last two are the size of a header, the header, and the items.
static void print_array(Text npy) {
    long items = -1, start = npy.size > 10 ? 10 + (unsigned char)npy.data[8] + 256 * (unsigned char)npy.data[9] : 0;
    int end = 0, is_npy = start && start <= npy.size && !memcmp(npy.data, "\x93NUMPY\1", 8);
    if (is_npy) sscanf(npy.data + 10, "{'descr': '<f8', 'fortran_order': False, 'shape': (%ld,), }%n", &items, &end);
    check(end && 10 + end < start && items >= 0 && npy.size == start + 8.0 * items, "%s%s: not float64[n]", key, path);
    printf("{\"dtype\":\"<f8\",\"shape\":[%ld],\"data\":[", items);
    for (long at = 0; at < items; at++) {
        double item;
        memcpy(&item, npy.data + start + 8 * at, sizeof item);
        printf(at ? ",%.17g" : "%.17g", item);
    }
    printf("]}");
}

// Read value, array and note (publisher and number of the last update) of one instant. Print them if the note is new.
static int show(char *note, const char *before) {
    char placeholder[200];
    int size = snprintf(placeholder, sizeof placeholder, "\"$ship numpy %s ", path);
    const char *form = "MULTI\r\nJSON.GET %s %s\r\nGET {%s}%s\r\nGET {%s}:last\r\nEXEC\r\n";
    fprintf(out, form, key, *path ? path : ".", key, path, key);
    check(next_lines(in, "++++*") == 3, "the server did not read");
    Text json = next_text(in), array = next_text(in), last = next_text(in);
    int is_array = json.data && array.data && !strncmp(json.data, placeholder, size);
    int is_new = !*note || (last.data && strcmp(last.data, note));
    check(json.data || *before, "nothing is stored at %s", key);
    check(is_array || !json.data || !strstr(json.data, "\"$ship "), "%s%s is not JSON: get one array", key, path);
    if (is_new) {
        snprintf(note, 90, "%s", last.data ? last.data : "unknown");
        printf(before, note);
        if (is_array) print_array(array);
        else printf("%s", json.data ? json.data : "null");
        printf(*before ? "}\n" : "\n");
        fflush(stdout);
    }
    free(json.data);
    free(array.data);
    free(last.data);
    return is_new;
}

// Print the value, and again after each update. A notice is a reason to read, and each second is one.
static void watch(const char *url, long lines) {
    char notice[4096], note[90] = "";
    FILE *notices = subscribe(url, "notices", 1);
    while ((lines -= show(note, "{\"update\":\"%s\",\"value\":")) > 0) {
        check(recv(fileno(notices), notice, sizeof notice, 0), "the server closed the connection");
    }
}

// Replace a key by JSON and have its subscribers read it, in one transaction. RedisJSON reads 15 digits exactly.
static void publish(const char *json) {
    char notice[200];
    for (const char *digits = "0123456789.", *at = json; (at = strpbrk(at, digits));) {
        size_t size = strspn(at, digits);
        check(size <= 16 && at[size] != 'e' && at[size] != 'E', "over 15 digits, or an exponent: %.20s", at);
        at += size;
    }
    check(!*path && !strpbrk(json, "'\r\n") && !strstr(json, "$ship "), "publish JSON without ' at a key such as arm");
    fprintf(out, "WATCH %s {%s}:ships {%s}:lease\r\nEXISTS {%s}:lease\r\n", key, key, key, key);
    fprintf(out, "EXISTS {%s}:ships\r\nJSON.TYPE %s\r\n", key, key);
    check(next_lines(in, "+:") == 0, "%s is owned by another program", key);
    check(next_lines(in, ":") == 0, "%s has arrays, which this client would leave behind", key);
    free(next_text(in).data); // an error if the key is of another program
    snprintf(notice, sizeof notice, "[1,\"%016llx\",1,%ld,[],\"look\",0,[]]\n", ids[0], (long)time(NULL));
    fprintf(out, "MULTI\r\nJSON.SET %s $ '%s'\r\nSET {%s}:last \"%016llx 1\" EX 60\r\n", key, json, key, ids[0]);
    write_publish(":notices", notice);
    fprintf(out, "EXEC\r\n");
    check(next_lines(in, "++++*") == 3, "another client wrote %s at the same time: publish again", key);
    next_lines(in, "++:");
}

// Send the arguments to one program that serves, and print its answer. Both sides give up after ten seconds.
static void call(const char *url, const char *arguments) {
    char text[16000];
    Text server = {NULL, 0};
    snprintf(text, sizeof text, "answers@%016llx", ids[0]);
    FILE *answers = subscribe(url, text, 10);
    fprintf(out, "PUBSUB CHANNELS {%s}%s:serve@????????????????\r\n", key, path);
    for (long servers = next_lines(in, "*"); servers > 0; servers--) server = next_text(in);
    check(server.size > 16 && strchr(server.data, '}'), "no program serves %s%s", key, path);
    const char *form = "[1,\"call\",\"%016llx\",\"%016llx\",10,[\"\",\"\"],\"here\",%zu,[]]\n%s";
    long size = snprintf(text, sizeof text, form, ids[1], ids[0], strlen(arguments), arguments);
    check(size < (long)sizeof text && !strstr(arguments, "$ship "), "the arguments are over 15 kB, or have arrays");
    write_publish(strchr(server.data, '}') + 1, text);
    check(next_lines(in, ":") > 0, "the program that served %s%s has just ended: call again", key, path);
    check(ungetc(getc(answers), answers) != EOF, "no answer in 10 s; the call may or may not have been handled");
    next_lines(answers, "*$m${"); // a list of the word message, the channel, and what was published
    char *line = next_text(answers).data, *value = line;
    snprintf(text, sizeof text, "\",\"%016llx\",\"%s\",", ids[1], server.data + server.size - 16);
    check(strsep(&value, "\n") && value && strstr(line, text), "an answer to something else");
    int is_here = sscanf(line, "[1,\"answer\",%*[^,],%*[^,],%*f,[%*[^]]],\"here\",%ld,", &size) == 1;
    check(is_here && size == (long)strlen(value) && !strstr(value, "\"$ship "), "not JSON up to 64 kB: %.200s", line);
    puts(value);
}

int main(int count, char **words) {
    check(count > 3, "usage: reem URL get|publish|watch|call PLACE [JSON | LINES]");
    char note[90] = "", *url = words[1], *action = words[2], *place = words[3], *word = words[4];
    int end = 0;
    sscanf(place, "%127[A-Za-z0-9_:]%n%127[].[A-Za-z0-9_]%n", key, &end, path, &end);
    check(end && !place[end] && !strstr(path, ".."), "the place is not like arm.joints[0]");
    check(getrandom(ids, sizeof ids, 0) == sizeof ids, "no random numbers");
    signal(SIGPIPE, SIG_IGN);
    in = connect_to(url, 5);
    out = fdopen(fileno(in), "w");
    if (!strcmp(action, "get")) show(note, "");
    else if (!strcmp(action, "watch")) watch(url, word ? atol(word) : 1 << 30);
    else if (!strcmp(action, "publish") && word) publish(word);
    else if (!strcmp(action, "call") && word) call(url, word);
    else errx(1, "not get, watch, publish with JSON, or call with JSON");
}
