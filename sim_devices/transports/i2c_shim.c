/* Shows emulated I2C buses to unmodified programs as /dev/i2c-N.

   Use: MICRON_I2C=FOLDER LD_PRELOAD=i2c_shim.so PROGRAM. /dev/i2c-N is the Unix socket FOLDER/i2c-N where that exists,
   and the machine's own device file where it does not. The socket's protocol is described in hal/backends/unix_i2c.py.
   Behaviour follows Documentation/i2c/dev-interface and fault-codes of Linux: an address that nobody acknowledges is
   ENXIO, a refused data byte EREMOTEIO, a bus error EIO. A call returns when the transfer's bus time has passed.

   Supported: open, openat, read, write, close, stat and access; I2C_SLAVE, I2C_SLAVE_FORCE, I2C_FUNCS, I2C_RDWR (one
   address per call), I2C_SMBUS (quick, byte, byte data, word data, process call, block write, I2C block),
   I2C_TIMEOUT, I2C_RETRIES, I2C_PEC off. Not supported: ten-bit addresses, PEC, block reads whose length the device
   sends, dup of the descriptor, programs that are linked statically. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/i2c-dev.h>
#include <linux/i2c.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/sysmacros.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#define DESCRIPTORS 1024
#define LONGEST 8192    /* bytes of one message, limit of i2c-dev */
#define PREFIX "/dev/i2c-"
#define CHARACTER_MAJOR 89

struct part {
    int reads;
    uint16_t length;
    uint8_t *data;
};

static struct {
    int is_open;
    int address;
} buses[DESCRIPTORS];
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;

/* The function of this name in the next library. */
#define REAL(name)                                                                                                     \
    ({                                                                                                                 \
        static __typeof__(&name) real;                                                                                 \
        if (!real)                                                                                                     \
            real = (__typeof__(&name))dlsym(RTLD_NEXT, #name);                                                         \
        real;                                                                                                          \
    })

static int is_bus(int fd) { return fd >= 0 && fd < DESCRIPTORS && buses[fd].is_open; }

/* Bus number of an emulated path, whose socket goes to `socket`; -1 for every other path. */
static int bus_number(const char *path, char *socket, size_t size)
{
    const char *folder = getenv("MICRON_I2C");
    if (!folder || !path || strncmp(path, PREFIX, sizeof PREFIX - 1))
        return -1;
    char *end;
    long number = strtol(path + sizeof PREFIX - 1, &end, 10);
    if (*end || end == path + sizeof PREFIX - 1 || number < 0)
        return -1;
    if ((size_t)snprintf(socket, size, "%s/i2c-%ld", folder, number) >= size)
        return -1;
    return REAL(access)(socket, F_OK) ? -1 : (int)number;
}

static int open_bus(const char *socket_path, int flags)
{
    struct sockaddr_un at = {.sun_family = AF_UNIX};
    if (strlen(socket_path) >= sizeof at.sun_path) {
        errno = ENAMETOOLONG;
        return -1;
    }
    strcpy(at.sun_path, socket_path);
    int fd = socket(AF_UNIX, SOCK_STREAM | (flags & O_CLOEXEC ? SOCK_CLOEXEC : 0), 0);
    if (fd < 0)
        return -1;
    if (fd >= DESCRIPTORS || connect(fd, (struct sockaddr *)&at, sizeof at)) {
        int code = fd >= DESCRIPTORS ? EMFILE : ENODEV;
        REAL(close)(fd);
        errno = code;
        return -1;
    }
    buses[fd].is_open = 1;
    buses[fd].address = 0;
    return fd;
}

static int receive_all(int fd, uint8_t *data, size_t n)
{
    while (n) {
        ssize_t got = recv(fd, data, n, 0);
        if (got < 0 && errno == EINTR)
            continue;
        if (got <= 0)
            return -1;
        data += got;
        n -= (size_t)got;
    }
    return 0;
}

static int send_all(int fd, const uint8_t *data, size_t n)
{
    while (n) {
        ssize_t sent = send(fd, data, n, MSG_NOSIGNAL);
        if (sent < 0 && errno == EINTR)
            continue;
        if (sent <= 0)
            return -1;
        data += sent;
        n -= (size_t)sent;
    }
    return 0;
}

/* One transfer: START, the parts with repeated STARTs between them, STOP. 0, or -1 with errno. */
static int transfer(int fd, int address, struct part *parts, int count)
{
    static const int codes[] = {0, ENXIO, EREMOTEIO, EIO};
    size_t size = 10, back = 0;
    for (int i = 0; i < count; i++) {
        size += 3 + (parts[i].reads ? 0 : parts[i].length);
        back += parts[i].reads ? parts[i].length : 0;
    }
    uint8_t *request = malloc(size), *answer = malloc(back + 1), head[3];
    if (!request || !answer) {
        free(request);
        free(answer);
        errno = ENOMEM;
        return -1;
    }
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    int64_t now_ns = (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
    uint8_t *at = request;
    *at++ = (uint8_t)address;
    *at++ = (uint8_t)count;
    for (int i = 0; i < 8; i++)
        *at++ = (uint8_t)((uint64_t)now_ns >> 8 * i);
    for (int i = 0; i < count; i++) {
        *at++ = parts[i].reads ? 1 : 0;
        *at++ = (uint8_t)parts[i].length;
        *at++ = (uint8_t)(parts[i].length >> 8);
        if (!parts[i].reads) {
            memcpy(at, parts[i].data, parts[i].length);
            at += parts[i].length;
        }
    }
    int code = 0;
    pthread_mutex_lock(&lock);
    if (send_all(fd, request, size) || receive_all(fd, head, 3))
        code = ENODEV;
    else if ((size_t)(head[1] | head[2] << 8) > back || receive_all(fd, answer, head[1] | head[2] << 8))
        code = EIO;
    else
        code = head[0] < 4 ? codes[head[0]] : EIO;
    pthread_mutex_unlock(&lock);
    if (!code) {
        uint8_t *from = answer;
        for (int i = 0; i < count; i++)
            if (parts[i].reads) {
                memcpy(parts[i].data, from, parts[i].length);
                from += parts[i].length;
            }
    }
    free(request);
    free(answer);
    errno = code ? code : errno;
    return code ? -1 : 0;
}

static int refuse(int code)
{
    errno = code;
    return -1;
}

static int read_write(int fd, struct i2c_rdwr_ioctl_data *order)
{
    struct part parts[I2C_RDWR_IOCTL_MAX_MSGS];
    if (!order || order->nmsgs < 1 || order->nmsgs > I2C_RDWR_IOCTL_MAX_MSGS)
        return refuse(EINVAL);
    for (unsigned i = 0; i < order->nmsgs; i++) {
        struct i2c_msg *message = &order->msgs[i];
        if (message->len > LONGEST)
            return refuse(EINVAL);
        if (message->flags & ~I2C_M_RD || message->addr != order->msgs[0].addr)
            return refuse(EOPNOTSUPP);
        parts[i] = (struct part){message->flags & I2C_M_RD, message->len, message->buf};
    }
    return transfer(fd, order->msgs[0].addr, parts, (int)order->nmsgs) ? -1 : (int)order->nmsgs;
}

static int smbus(int fd, struct i2c_smbus_ioctl_data *order)
{
    uint8_t out[2 + I2C_SMBUS_BLOCK_MAX + 1] = {order->command};
    union i2c_smbus_data *data = order->data;
    int address = buses[fd].address, reads = order->read_write == I2C_SMBUS_READ, n;
    struct part parts[2] = {{0, 1, out}, {1, 0, NULL}};
    switch (order->size) {
    case I2C_SMBUS_QUICK:
        parts[0] = (struct part){reads, 0, out};
        return transfer(fd, address, parts, 1);
    case I2C_SMBUS_BYTE:
        if (reads)
            parts[0] = (struct part){1, 1, &data->byte};
        return transfer(fd, address, parts, 1);
    case I2C_SMBUS_BYTE_DATA:
    case I2C_SMBUS_WORD_DATA:
        n = order->size == I2C_SMBUS_BYTE_DATA ? 1 : 2;
        if (reads) {
            parts[1] = (struct part){1, (uint16_t)n, data->block};
            if (transfer(fd, address, parts, 2))
                return -1;
            if (n == 2)
                data->word = (uint16_t)(data->block[0] | data->block[1] << 8);
            return 0;
        }
        out[1] = n == 1 ? data->byte : (uint8_t)data->word;
        out[2] = n == 1 ? 0 : (uint8_t)(data->word >> 8);
        parts[0].length = (uint16_t)(1 + n);
        return transfer(fd, address, parts, 1);
    case I2C_SMBUS_PROC_CALL:
        out[1] = (uint8_t)data->word;
        out[2] = (uint8_t)(data->word >> 8);
        parts[0].length = 3;
        parts[1] = (struct part){1, 2, data->block};
        if (transfer(fd, address, parts, 2))
            return -1;
        data->word = (uint16_t)(data->block[0] | data->block[1] << 8);
        return 0;
    case I2C_SMBUS_BLOCK_DATA:
    case I2C_SMBUS_I2C_BLOCK_DATA:
    case I2C_SMBUS_I2C_BLOCK_BROKEN:
        if (reads && order->size == I2C_SMBUS_BLOCK_DATA)
            return refuse(EOPNOTSUPP);
        n = order->size == I2C_SMBUS_I2C_BLOCK_BROKEN && reads ? I2C_SMBUS_BLOCK_MAX : data->block[0];
        if (n < 1 || n > I2C_SMBUS_BLOCK_MAX)
            return refuse(EINVAL);
        if (reads) {
            parts[1] = (struct part){1, (uint16_t)n, data->block + 1};
            data->block[0] = (uint8_t)n;
            return transfer(fd, address, parts, 2);
        }
        int head = order->size == I2C_SMBUS_BLOCK_DATA ? 2 : 1; /* an SMBus block carries its length */
        out[1] = (uint8_t)n;
        memcpy(out + head, data->block + 1, (size_t)n);
        parts[0].length = (uint16_t)(head + n);
        return transfer(fd, address, parts, 1);
    default:
        return refuse(EOPNOTSUPP);
    }
}

int ioctl(int fd, unsigned long request, ...)
{
    va_list rest;
    va_start(rest, request);
    void *argument = va_arg(rest, void *);
    va_end(rest);
    if (!is_bus(fd))
        return REAL(ioctl)(fd, request, argument);
    switch (request) {
    case I2C_SLAVE:
    case I2C_SLAVE_FORCE:
        if ((unsigned long)argument > 0x7F)
            return refuse(EINVAL);
        buses[fd].address = (int)(unsigned long)argument;
        return 0;
    case I2C_TENBIT:
    case I2C_PEC:
        return argument ? refuse(EOPNOTSUPP) : 0;
    case I2C_TIMEOUT:
    case I2C_RETRIES:
        return 0;
    case I2C_FUNCS:
        *(unsigned long *)argument = I2C_FUNC_I2C | I2C_FUNC_SMBUS_QUICK | I2C_FUNC_SMBUS_BYTE |
                                     I2C_FUNC_SMBUS_BYTE_DATA | I2C_FUNC_SMBUS_WORD_DATA | I2C_FUNC_SMBUS_PROC_CALL |
                                     I2C_FUNC_SMBUS_WRITE_BLOCK_DATA | I2C_FUNC_SMBUS_I2C_BLOCK;
        return 0;
    case I2C_RDWR:
        return read_write(fd, argument);
    case I2C_SMBUS:
        return smbus(fd, argument);
    default: /* FIOCLEX and the like */
        return REAL(ioctl)(fd, request, argument);
    }
}

ssize_t read(int fd, void *data, size_t n)
{
    if (!is_bus(fd))
        return REAL(read)(fd, data, n);
    n = n > LONGEST ? LONGEST : n;
    struct part part = {1, (uint16_t)n, data};
    return transfer(fd, buses[fd].address, &part, 1) ? -1 : (ssize_t)n;
}

ssize_t write(int fd, const void *data, size_t n)
{
    if (!is_bus(fd))
        return REAL(write)(fd, data, n);
    n = n > LONGEST ? LONGEST : n;
    struct part part = {0, (uint16_t)n, (uint8_t *)data};
    return transfer(fd, buses[fd].address, &part, 1) ? -1 : (ssize_t)n;
}

int close(int fd)
{
    if (is_bus(fd))
        buses[fd].is_open = 0;
    return REAL(close)(fd);
}

#define MODE_OF(flags)                                                                                                 \
    mode_t mode = 0;                                                                                                   \
    if ((flags) & O_CREAT || ((flags) & O_TMPFILE) == O_TMPFILE) {                                                     \
        va_list rest;                                                                                                  \
        va_start(rest, flags);                                                                                         \
        mode = (mode_t)va_arg(rest, int);                                                                              \
        va_end(rest);                                                                                                  \
    }                                                                                                                  \
    char at[128]

#define OPENS(name)                                                                                                    \
    int name(const char *path, int flags, ...)                                                                         \
    {                                                                                                                  \
        MODE_OF(flags);                                                                                                \
        return bus_number(path, at, sizeof at) >= 0 ? open_bus(at, flags) : REAL(name)(path, flags, mode);             \
    }
#define OPENS_AT(name)                                                                                                 \
    int name(int folder, const char *path, int flags, ...)                                                             \
    {                                                                                                                  \
        MODE_OF(flags);                                                                                                \
        return bus_number(path, at, sizeof at) >= 0 ? open_bus(at, flags) : REAL(name)(folder, path, flags, mode);     \
    }
OPENS(open)
OPENS(open64)
OPENS_AT(openat)
OPENS_AT(openat64)

/* Calls that programs compiled with _FORTIFY_SOURCE make. */
int __open_2(const char *path, int flags) { return open(path, flags); }
int __open64_2(const char *path, int flags) { return open64(path, flags); }
int __openat_2(int folder, const char *path, int flags) { return openat(folder, path, flags); }
int __openat64_2(int folder, const char *path, int flags) { return openat64(folder, path, flags); }

#define STATS(name, type, before, call)                                                                                \
    int name before                                                                                                    \
    {                                                                                                                  \
        char at[128];                                                                                                  \
        int number = bus_number(path, at, sizeof at);                                                                  \
        if (number < 0)                                                                                                \
            return REAL(name) call;                                                                                    \
        memset(found, 0, sizeof *found);                                                                               \
        found->st_mode = S_IFCHR | 0600;                                                                               \
        found->st_rdev = makedev(CHARACTER_MAJOR, number);                                                             \
        found->st_nlink = 1;                                                                                           \
        found->st_uid = getuid();                                                                                      \
        return 0;                                                                                                      \
    }
STATS(stat, struct stat, (const char *path, struct stat *found), (path, found))
STATS(stat64, struct stat64, (const char *path, struct stat64 *found), (path, found))
STATS(lstat, struct stat, (const char *path, struct stat *found), (path, found))
STATS(lstat64, struct stat64, (const char *path, struct stat64 *found), (path, found))
STATS(fstatat, struct stat, (int folder, const char *path, struct stat *found, int flags),
      (folder, path, found, flags))
STATS(fstatat64, struct stat64, (int folder, const char *path, struct stat64 *found, int flags),
      (folder, path, found, flags))

int access(const char *path, int mode)
{
    char at[128];
    return bus_number(path, at, sizeof at) >= 0 ? REAL(access)(at, mode) : REAL(access)(path, mode);
}

int faccessat(int folder, const char *path, int mode, int flags)
{
    char at[128];
    return bus_number(path, at, sizeof at) >= 0 ? REAL(access)(at, mode) : REAL(faccessat)(folder, path, mode, flags);
}
