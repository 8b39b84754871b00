/* A video device that is not there: /dev/video77 for a process that loads this before its C library.
 *
 * It answers what the kernel's V4L2 interface asks of a UVC camera (videodev2.h), and gives YUYV pictures at the rate
 * that was set, by a timer that can be waited for like a device. The first eight luma values of a picture are when its
 * exposure began, s on the monotonic clock; the stamp is that of its first bytes, after the exposure.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/videodev2.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/select.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

#define PATH "/dev/video77"
#define MOST 8

static int device = -1, streaming, rate = 30, exposure = 100, gain = 10, sequence;
static unsigned width = 640, height = 480, count;
static unsigned char *memory[MOST];
static int queued[MOST], length;
static double paced;
static uint64_t pictures;

static size_t size(void) { return (size_t)width * height * 2; }

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + 1e-9 * t.tv_nsec;
}

static void pace(void) {
    struct itimerspec every = {{0, 0}, {0, 0}};
    if (streaming) every.it_interval.tv_nsec = every.it_value.tv_nsec = 1000000000L / rate - (rate == 1);
    timerfd_settime(device, 0, &every, NULL);
    paced = now(), pictures = 0;
}

static int format(struct v4l2_format *f, int set) {
    struct v4l2_pix_format *p = &f->fmt.pix;
    if (f->type != V4L2_BUF_TYPE_VIDEO_CAPTURE) return EINVAL;
    if (set && p->pixelformat == V4L2_PIX_FMT_YUYV && p->width <= 640 && p->height <= 480)
        width = p->width & ~1u, height = p->height;
    memset(p, 0, sizeof *p);
    p->width = width, p->height = height, p->pixelformat = V4L2_PIX_FMT_YUYV, p->field = V4L2_FIELD_NONE;
    p->bytesperline = 2 * width, p->sizeimage = size(), p->colorspace = V4L2_COLORSPACE_SRGB;
    return 0;
}

static int *control(unsigned id, int *low, int *high) {
    static int automatic = 3;
    *low = 1, *high = 5000;
    if (id == V4L2_CID_EXPOSURE_ABSOLUTE) return &exposure;
    *low = 0, *high = 100;
    if (id == V4L2_CID_GAIN) return &gain;
    *high = 3;
    return id == V4L2_CID_EXPOSURE_AUTO ? &automatic : NULL;
}

static int take(struct v4l2_buffer *b) {
    uint64_t ticks;
    if (!streaming || length == 0) return EINVAL;
    if (read(device, &ticks, sizeof ticks) != sizeof ticks) return EAGAIN;
    sequence += (int)ticks, pictures += ticks;
    int index = queued[0];
    memmove(queued, queued + 1, --length * sizeof *queued);
    double came = paced + (double)pictures / rate, began = came - 1e-4 * exposure;
    for (size_t k = 0; k < size(); k += 2) memory[index][k] = 100, memory[index][k + 1] = 128;
    for (int k = 0; k < 8; k++) memory[index][2 * k] = ((unsigned char *)&began)[k];
    b->index = index, b->bytesused = size(), b->field = V4L2_FIELD_NONE, b->sequence = sequence;
    b->memory = V4L2_MEMORY_MMAP, b->length = size(), b->m.offset = index * 0x100000;
    b->flags = V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC | V4L2_BUF_FLAG_DONE | V4L2_BUF_FLAG_MAPPED;
    b->timestamp.tv_sec = (long)came, b->timestamp.tv_usec = (long)(1e6 * (came - (long)came));
    return 0;
}

static int answer(unsigned long request, void *what) {
    int low, high, *value;
    switch (request) {
    case VIDIOC_QUERYCAP: {
        struct v4l2_capability *c = what;
        memset(c, 0, sizeof *c);
        strcpy((char *)c->driver, "uvcvideo"), strcpy((char *)c->card, "No camera");
        c->capabilities = V4L2_CAP_VIDEO_CAPTURE | V4L2_CAP_STREAMING | V4L2_CAP_DEVICE_CAPS;
        c->device_caps = V4L2_CAP_VIDEO_CAPTURE | V4L2_CAP_STREAMING;
        return 0;
    }
    case VIDIOC_G_INPUT: return *(int *)what = 0;
    case VIDIOC_S_INPUT: return 0;
    case VIDIOC_ENUMINPUT: return ((struct v4l2_input *)what)->index ? EINVAL : 0;
    case VIDIOC_G_FMT: return format(what, 0);
    case VIDIOC_S_FMT: return streaming ? EBUSY : format(what, 1);
    case VIDIOC_TRY_FMT: return format(what, 0);
    case VIDIOC_G_PARM:
    case VIDIOC_S_PARM: {
        struct v4l2_captureparm *p = &((struct v4l2_streamparm *)what)->parm.capture;
        if (request == VIDIOC_S_PARM && p->timeperframe.numerator && p->timeperframe.denominator) {
            rate = (int)(p->timeperframe.denominator / p->timeperframe.numerator);
            rate = rate < 1 ? 1 : rate > 60 ? 60 : rate;
            pace();
        }
        p->capability = V4L2_CAP_TIMEPERFRAME, p->timeperframe.numerator = 1, p->timeperframe.denominator = rate;
        return 0;
    }
    case VIDIOC_QUERYCTRL: {
        struct v4l2_queryctrl *q = what;
        if (!(value = control(q->id, &low, &high))) return EINVAL;
        q->type = V4L2_CTRL_TYPE_INTEGER, q->minimum = low, q->maximum = high, q->step = 1, q->flags = 0;
        return 0;
    }
    case VIDIOC_G_CTRL:
    case VIDIOC_S_CTRL: {
        struct v4l2_control *c = what;
        if (!(value = control(c->id, &low, &high))) return EINVAL;
        if (request == VIDIOC_S_CTRL) *value = c->value < low ? low : c->value > high ? high : c->value;
        c->value = *value;
        return 0;
    }
    case VIDIOC_G_EXT_CTRLS:
    case VIDIOC_S_EXT_CTRLS: {
        struct v4l2_ext_controls *c = what;
        for (unsigned k = 0; k < c->count; k++) {
            if (!(value = control(c->controls[k].id, &low, &high))) return EINVAL;
            int v = c->controls[k].value;
            if (request == VIDIOC_S_EXT_CTRLS) *value = v < low ? low : v > high ? high : v;
            c->controls[k].value = *value;
        }
        return 0;
    }
    case VIDIOC_REQBUFS: {
        struct v4l2_requestbuffers *r = what;
        if (r->count && streaming) return EBUSY;
        for (unsigned k = 0; k < count; k++) free(memory[k]), memory[k] = NULL;
        count = r->count = r->count > MOST ? MOST : r->count, length = 0;
        for (unsigned k = 0; k < count; k++) memory[k] = malloc(size());
        return 0;
    }
    case VIDIOC_QUERYBUF: {
        struct v4l2_buffer *b = what;
        if (b->index >= count) return EINVAL;
        b->length = size(), b->m.offset = b->index * 0x100000;
        return 0;
    }
    case VIDIOC_QBUF: {
        struct v4l2_buffer *b = what;
        if (b->index >= count || length >= MOST) return EINVAL;
        queued[length++] = b->index;
        return 0;
    }
    case VIDIOC_DQBUF: return take(what);
    case VIDIOC_STREAMON: return streaming = 1, pace(), 0;
    case VIDIOC_STREAMOFF: return streaming = 0, length = 0, pace(), 0;
    default: return ENOTTY;
    }
}

#define REAL(name) dlsym(RTLD_NEXT, name)

static int opened(const char *path) {
    if (strcmp(path, PATH)) return -1;
    if (device >= 0) return errno = EBUSY, -2;
    return device = timerfd_create(CLOCK_MONOTONIC, TFD_NONBLOCK | TFD_CLOEXEC);
}

#define OPEN(name)                                                                                                     \
    int name(const char *path, int flags, ...) {                                                                       \
        va_list list;                                                                                                  \
        va_start(list, flags);                                                                                         \
        mode_t mode = va_arg(list, mode_t);                                                                            \
        va_end(list);                                                                                                  \
        int found = opened(path);                                                                                      \
        return found == -1 ? ((int (*)(const char *, int, mode_t))REAL(#name))(path, flags, mode) : found;             \
    }
OPEN(open)
OPEN(open64)

int close(int fd) {
    if (fd == device && fd >= 0) streaming = 0, device = -1;
    return ((int (*)(int))REAL("close"))(fd);
}

int ioctl(int fd, unsigned long request, ...) {
    va_list list;
    va_start(list, request);
    void *what = va_arg(list, void *);
    va_end(list);
    if (fd != device || fd < 0) return ((int (*)(int, unsigned long, ...))REAL("ioctl"))(fd, request, what);
    int error = answer(request & 0xFFFFFFFF, what);
    return error ? (errno = error, -1) : 0;
}

#define MMAP(name, offset_type)                                                                                        \
    void *name(void *at, size_t bytes, int protection, int flags, int fd, offset_type offset) {                        \
        if (fd == device && fd >= 0) return memory[offset / 0x100000];                                                 \
        return ((void *(*)(void *, size_t, int, int, int, offset_type))REAL(#name))(                                   \
            at, bytes, protection, flags, fd, offset);                                                                 \
    }
MMAP(mmap, off_t)
MMAP(mmap64, off64_t)

int munmap(void *at, size_t bytes) {
    for (unsigned k = 0; k < MOST; k++)
        if (at == memory[k] && at) return 0;
    return ((int (*)(void *, size_t))REAL("munmap"))(at, bytes);
}
