/* A lab's robot without REEM: one program that writes to a Redis server over a plain socket, as such programs do.
 *
 *     gcc -O2 -o lab lab.c && ./lab HOST PORT SECONDS
 *
 * A JSON string at 1 kHz, a packed image at 30 Hz, separated text and a stream at 100 Hz, a hash at 10 Hz. At the end, or
 * at SIGTERM, it prints how long the 1 kHz writes took, in microseconds: `writes 5000 p50 61.2 p99 140.9`.
 */
#include <arpa/inet.h>
#include <math.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#define ROWS 480
#define COLUMNS 640
#define IMAGE (ROWS * COLUMNS * 3)

static int server;
static volatile sig_atomic_t is_over;

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + t.tv_nsec / 1e9;
}

static void send_all(const void *data, size_t size) {
    const char *at = data;
    while (size > 0) {
        ssize_t sent = send(server, at, size, 0);
        if (sent <= 0) {
            perror("send");
            exit(1);
        }
        at += sent;
        size -= (size_t)sent;
    }
}

static char outgoing[IMAGE + 1024];
static size_t collected;

static void collect(const void *data, size_t size) {
    memcpy(outgoing + collected, data, size);
    collected += size;
}

/* Send one command and wait for its reply, which is one line, or a line and a short text. */
static void command(int words, const char *word[], const size_t size[]) {
    char line[64], reply[512];
    for (int i = -1; i < words; i++) {
        int length = i < 0 ? sprintf(line, "*%d\r\n", words) : sprintf(line, "$%zu\r\n", size[i]);
        collect(line, (size_t)length);
        if (i >= 0) {
            collect(word[i], size[i]);
            collect("\r\n", 2);
        }
    }
    send_all(outgoing, collected);
    collected = 0;
    if (recv(server, reply, sizeof reply, 0) <= 0 || reply[0] == '-') {
        fprintf(stderr, "the server refused %s\n", word[0]);
        exit(1);
    }
}

static void text_command(int words, const char *word[]) {
    size_t size[8];
    for (int i = 0; i < words; i++)
        size[i] = strlen(word[i]);
    command(words, word, size);
}

static void end(int number) {
    (void)number;
    is_over = 1;
}

static int ascending(const void *a, const void *b) {
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

int main(int count, char **given) {
    if (count != 4) {
        fprintf(stderr, "usage: %s HOST PORT SECONDS\n", given[0]);
        return 2;
    }
    struct sockaddr_in where = {.sin_family = AF_INET, .sin_port = htons((uint16_t)atoi(given[2]))};
    inet_pton(AF_INET, given[1], &where.sin_addr);
    server = socket(AF_INET, SOCK_STREAM, 0);
    int on = 1;
    setsockopt(server, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
    if (connect(server, (struct sockaddr *)&where, sizeof where) != 0) {
        perror("connect");
        return 1;
    }
    struct sigaction ending = {.sa_handler = end, .sa_flags = SA_RESTART};
    sigaction(SIGTERM, &ending, NULL);
    long turns = (long)(atof(given[3]) * 1000);
    double *took = calloc((size_t)turns + 1, sizeof *took), begun = now();
    static char image[IMAGE];
    long turn = 0;
    for (; turn < turns && !is_over; turn++) {
        double due = begun + turn / 1000.0, t = turn / 1000.0;
        while (now() < due)
            usleep((useconds_t)fmax((due - now()) * 1e6, 1));
        char text[256];
        sprintf(text, "[%.6f, %.6f, %.6f, %.6f, 0.1, 0.2, %ld]", sin(t), cos(t), sin(2 * t), cos(2 * t), turn);
        const char *joints[] = {"SET", "sai::sensors::Panda::joint_positions", text};
        double before = now();
        text_command(3, joints);
        took[turn] = now() - before;
        if (turn % 10 == 0) {
            sprintf(text, "%.6f %.6f %.6f", sin(t), cos(t), t);
            const char *force[] = {"SET", "sai::sensors::force", text};
            text_command(3, force);
            sprintf(text, "%.6f", cos(3 * t));
            const char *imu[] = {"XADD", "imu", "MAXLEN", "1000", "*", "ax", text};
            text_command(7, imu);
        }
        if (turn % 100 == 0) {
            sprintf(text, "%.3f", 24.0 - t / 100);
            const char *battery[] = {"HSET", "battery", "volts", text, "state", "ok"};
            text_command(6, battery);
        }
        if (turn % 33 == 0) {
            memset(image, (int)(turn / 33 % 200), sizeof image);
            for (int row = 0; row < ROWS; row++) /* a white bar that moves to the right */
                memset(image + (row * COLUMNS + turn / 8 % (COLUMNS - 40)) * 3, 255, 120);
            const char *camera[] = {"SET", "camera::rgb", image};
            size_t sizes[] = {3, 11, IMAGE};
            command(3, camera, sizes);
        }
    }
    turns = turn;
    qsort(took, (size_t)turns, sizeof *took, ascending);
    printf("writes %ld p50 %.1f p99 %.1f\n", turns, took[turns / 2] * 1e6, took[turns * 99 / 100] * 1e6);
    return 0;
}
