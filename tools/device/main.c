/* The reference device on a POSIX machine: camera and mirror of the rig section-vi, each behind a pseudo terminal. */
#define _XOPEN_SOURCE 600

#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/select.h>
#include <sys/stat.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include "camera.h"
#include "mirror.h"

static struct rig rig;
static struct camera camera;
static struct mirror mirror;
static volatile sig_atomic_t stopped;

struct port {
    int fd, host_fd; /* the pseudo terminal's own end; the host's, kept open so that it outlives a host */
};

static void stop(int signal)
{
    (void)signal;
    stopped = 1;
}

/* The device's clock: the processor's since the start, with the offset and the drift of the rig file. */
static int64_t device_ns(void)
{
    static struct timespec start;
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    if (start.tv_sec == 0)
        start = now;
    double since = (double)(now.tv_sec - start.tv_sec) * 1e9 + (double)(now.tv_nsec - start.tv_nsec);
    return CLOCK_OFFSET_NS + (int64_t)(since * (1.0 + CLOCK_DRIFT));
}

static struct port open_port(const char *what, const char *link)
{
    int line = posix_openpt(O_RDWR | O_NOCTTY);
    const char *path = line < 0 || grantpt(line) != 0 || unlockpt(line) != 0 ? NULL : ptsname(line);
    int host = path == NULL ? -1 : open(path, O_RDWR | O_NOCTTY);
    struct termios raw;
    /* Only this user may open it: the group tty may write to it otherwise. */
    if (host < 0 || fchmod(host, 0600) != 0 || tcgetattr(host, &raw) != 0 || fcntl(line, F_SETFL, O_NONBLOCK) != 0) {
        perror(what);
        exit(1);
    }
    raw.c_iflag = raw.c_oflag = raw.c_lflag = 0;
    raw.c_cflag = CS8 | CREAD | CLOCAL;
    tcsetattr(host, TCSANOW, &raw);
    struct stat old;
    if (link != NULL && lstat(link, &old) == 0 && S_ISLNK(old.st_mode))
        unlink(link); /* of a device that was killed; anything else stays, and symlink says that it is there */
    if (link != NULL && symlink(path, link) != 0) {
        perror(link);
        exit(1);
    }
    printf("%s  %s\n", what, link != NULL ? link : path);
    return (struct port){line, host};
}

static void send_what_goes(struct port port, struct line *line)
{
    if (line->cleared)
        tcflush(port.host_fd, TCIFLUSH); /* what the last host has not read is still in the terminal */
    line->cleared = false;
    ssize_t n = line->out_size > 0 ? write(port.fd, line->out, line->out_size) : 0;
    if (n > 0)
        line_sent(line, (size_t)n);
}

/* Every fast step that has begun, in order, however late this process is. */
static int64_t advance(void)
{
    int64_t now = device_ns();
    while (mirror.step_zero_ns + (int64_t)(mirror.step + 1) * FAST_STEP_NS <= now) {
        mirror_tick(&mirror);
        camera_tick(&camera);
    }
    return now;
}

static void receive(int fd, bool is_camera)
{
    uint8_t bytes[4096]; /* as much as a pseudo terminal holds */
    ssize_t n = read(fd, bytes, sizeof bytes);
    int64_t now = advance();
    for (ssize_t i = 0; i < n; i++) {
        if (is_camera)
            camera_take(&camera, bytes[i], now);
        else
            mirror_take(&mirror, bytes[i], now);
    }
}

static void serve(struct port camera_port, struct port mirror_port)
{
    int camera_fd = camera_port.fd, mirror_fd = mirror_port.fd;
    int highest = camera_fd > mirror_fd ? camera_fd : mirror_fd;
    while (!stopped) {
        fd_set readable, writable;
        FD_ZERO(&readable);
        FD_ZERO(&writable);
        FD_SET(camera_fd, &readable);
        FD_SET(mirror_fd, &readable);
        if (camera.line.out_size > 0)
            FD_SET(camera_fd, &writable);
        if (mirror.line.out_size > 0)
            FD_SET(mirror_fd, &writable);
        int64_t before = device_ns(), left = mirror.step_zero_ns + (int64_t)(mirror.step + 1) * FAST_STEP_NS - before;
        struct timespec wait = {0, left > 0 ? (long)left : 0};
        if (pselect(highest + 1, &readable, &writable, NULL, &wait, NULL) < 0) {
            if (errno == EINTR)
                continue;
            perror("pselect");
            return;
        }
        advance();
        if (FD_ISSET(camera_fd, &readable))
            receive(camera_fd, true);
        if (FD_ISSET(mirror_fd, &readable))
            receive(mirror_fd, false);
        /* Whatever came before pselect has been read: a process that had to wait must not take itself for a silent host. */
        mirror_watchdog(&mirror, before);
        send_what_goes(camera_port, &camera.line);
        send_what_goes(mirror_port, &mirror.line);
    }
}

int main(int argc, char **argv)
{
    const char *camera_link = NULL, *mirror_link = NULL;
    unsigned long long seed = SEED;
    for (int option; (option = getopt(argc, argv, "s:c:m:")) != -1;) {
        if (option == 's')
            seed = strtoull(optarg, NULL, 10);
        else if (option == 'c')
            camera_link = optarg;
        else if (option == 'm')
            mirror_link = optarg;
        else {
            fprintf(stderr, "usage: device [-s SEED] [-c LINK] [-m LINK], links to make to camera and mirror\n");
            return 2;
        }
    }
    struct sigaction action;
    memset(&action, 0, sizeof action);
    action.sa_handler = stop;
    sigaction(SIGINT, &action, NULL);
    sigaction(SIGTERM, &action, NULL);
    struct port camera_port = open_port("camera", camera_link), mirror_port = open_port("mirror", mirror_link);
    fflush(stdout);
    rig_begin(&rig, seed);
    int64_t step_zero_ns = device_ns();
    mirror_begin(&mirror, &rig, step_zero_ns);
    camera_begin(&camera, &rig, step_zero_ns);
    serve(camera_port, mirror_port);
    if (camera_link != NULL)
        unlink(camera_link);
    if (mirror_link != NULL)
        unlink(mirror_link);
    return 0;
}
