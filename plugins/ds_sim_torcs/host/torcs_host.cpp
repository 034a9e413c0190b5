// SPDX-License-Identifier: GPL-2.0-or-later
// Steps one TORCS car and draws what a camera sees of one world, in a process of its own, without a window.
//
// It loads the unpatched modules track.so, simuv2.so and ssggraph.so of TORCS 1.3.7 and draws on EGL's surfaceless
// platform. Requests come on standard input, answers go to what was standard output; both are little-endian:
//
//     uint32 kind, uint32 size, then `size` bytes
//
// An answer has the kind of its request; kind 0 is an error, whose bytes are one line of text, after which the host
// ends. It also ends when standard input closes or its parent is gone, and then removes its working folder.

#include <EGL/egl.h>
#include <EGL/eglext.h>
#define GL_GLEXT_PROTOTYPES
#include <GL/gl.h>
#include <GL/glext.h>
#include <dlfcn.h>
#include <poll.h>
#include <signal.h>
#include <unistd.h>

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <string>
#include <vector>

#include <plib/ssg.h>
#include <tgf.h>
#include <track.h>
#include <car.h>
#include <raceman.h>
#include <robottools.h>
#include <simu.h>
#include <graphic.h>

// What TORCS's own main program, GLX and GLUT would provide to the libraries.
void stopMenuMusic() {}
extern "C" {
// PLIB asks GLX whether a context is current before it starts; EGL's is.
__attribute__((visibility("default"))) void* glXGetCurrentContext() { return reinterpret_cast<void*>(1); }
__attribute__((visibility("default"))) int glutExtensionSupported(const char*) { return 0; }
}
void checkGLFeatures();  // of libtgfclient: without it the largest texture is 0 and loading one never ends

namespace {

enum Kind : uint32_t { ERROR = 0, HELLO = 1, CAR = 2, STEP = 3, ROAD = 4, VIEW = 5 };

constexpr double SUBSTEP = 0.002;      // s, TORCS's own
constexpr float PLANE_LIMIT = 3900.0f;  // m from the middle of the plane, whose half is 4 km
constexpr float NEAR = 0.3f, FAR = 2500.0f;

int answers = -1;    // descriptor on which answers go
std::string folder;  // working folder, made for this host alone

[[noreturn]] void leave() {
    std::error_code ignored;
    std::filesystem::remove_all(folder, ignored);  // removes links to TORCS's data, not what they point to
    _exit(0);
}

void write_all(const void* data, size_t size) {
    auto* from = static_cast<const char*>(data);
    while (size > 0) {
        ssize_t done = write(answers, from, size);
        if (done <= 0) leave();
        from += done;
        size -= static_cast<size_t>(done);
    }
}

void answer(uint32_t kind, const void* data, size_t size) {
    uint32_t head[2] = {kind, static_cast<uint32_t>(size)};
    write_all(head, sizeof head);
    write_all(data, size);
}

[[noreturn]] void fail(const std::string& what) {
    answer(ERROR, what.data(), what.size());
    _exit(2);
}

// Fills the memory from standard input; ends the process when that closes or the parent is gone.
void read_all(void* data, size_t size) {
    static const pid_t parent = getppid();
    auto* into = static_cast<char*>(data);
    while (size > 0) {
        pollfd waiting = {0, POLLIN, 0};
        if (poll(&waiting, 1, 1000) == 0) {
            if (getppid() != parent) leave();
            continue;
        }
        ssize_t got = read(0, into, size);
        if (got <= 0) leave();
        into += got;
        size -= static_cast<size_t>(got);
    }
}

struct Request {
    uint32_t kind;
    std::vector<char> bytes;

    template <class T> T as() const {
        T value;
        if (bytes.size() != sizeof value) fail("request " + std::to_string(kind) + " of a wrong size");
        memcpy(&value, bytes.data(), sizeof value);
        return value;
    }
};

Request next_request() {
    uint32_t head[2];
    read_all(head, sizeof head);
    if (head[1] > 4096) fail("request larger than 4096 bytes");
    Request request{head[0], std::vector<char>(head[1])};
    read_all(request.bytes.data(), head[1]);
    return request;
}

// ---------------------------------------------------------------------------------------------------- graphics

int width, height;
GLuint drawn, resolved;  // buffers of 4 samples a pixel, and of one
ssgContext* camera;
void (*draw_scene)();
int (*init_scene)();
ssgBranch** sun;
tGraphicItf graphics;
tTrack world;  // what ssggraph.so reads of a track; its road is a mesh alone
bool has_world = false;

void make_context() {
    auto display_of = reinterpret_cast<PFNEGLGETPLATFORMDISPLAYEXTPROC>(eglGetProcAddress("eglGetPlatformDisplayEXT"));
    EGLDisplay display =
        display_of ? display_of(EGL_PLATFORM_SURFACELESS_MESA, EGL_DEFAULT_DISPLAY, nullptr) : EGL_NO_DISPLAY;
    if (display == EGL_NO_DISPLAY || !eglInitialize(display, nullptr, nullptr)) fail("EGL has no surfaceless display");
    eglBindAPI(EGL_OPENGL_API);
    const EGLint wanted[] = {EGL_SURFACE_TYPE, EGL_PBUFFER_BIT, EGL_RENDERABLE_TYPE, EGL_OPENGL_BIT, EGL_NONE};
    EGLConfig config;
    EGLint found = 0;
    if (!eglChooseConfig(display, wanted, &config, 1, &found) || found < 1) fail("EGL has no configuration");
    EGLContext context = eglCreateContext(display, config, EGL_NO_CONTEXT, nullptr);
    if (context == EGL_NO_CONTEXT || !eglMakeCurrent(display, EGL_NO_SURFACE, EGL_NO_SURFACE, context))
        fail("EGL makes no context of OpenGL");
}

// Makes a buffer of the image's size with some samples a pixel. Those of EGL are one in llvmpipe, whatever it says.
GLuint make_buffer(int samples) {
    GLuint buffer, parts[2];
    glGenFramebuffers(1, &buffer);
    glGenRenderbuffers(2, parts);
    glBindFramebuffer(GL_FRAMEBUFFER, buffer);
    const GLenum formats[] = {GL_RGB8, GL_DEPTH_COMPONENT24}, places[] = {GL_COLOR_ATTACHMENT0, GL_DEPTH_ATTACHMENT};
    for (int i = 0; i < 2; i++) {
        glBindRenderbuffer(GL_RENDERBUFFER, parts[i]);
        glRenderbufferStorageMultisample(GL_RENDERBUFFER, samples, formats[i], width, height);
        glFramebufferRenderbuffer(GL_FRAMEBUFFER, places[i], GL_RENDERBUFFER, parts[i]);
    }
    if (glCheckFramebufferStatus(GL_FRAMEBUFFER) != GL_FRAMEBUFFER_COMPLETE) fail("OpenGL has no buffer of 4 samples");
    return buffer;
}

template <class Interface> void* load_module(const std::string& path, const char* entry, Interface* interface) {
    void* library = dlopen(path.c_str(), RTLD_NOW | RTLD_GLOBAL);
    if (!library) fail(dlerror());
    auto describe = reinterpret_cast<int (*)(tModInfo*)>(dlsym(library, entry));
    if (!describe) fail(path + " lacks " + entry);
    tModInfo about[MAX_MOD_ITF] = {};
    describe(about);
    about[0].fctInit(about[0].index, interface);
    return library;
}

template <class T> void find_symbol(void* library, const char* name, T& into) {
    into = reinterpret_cast<T>(dlsym(library, name));
    if (!into) fail(std::string("ssggraph.so lacks ") + name + ": expected that of TORCS 1.3.7");
}

void load_graphics(const std::string& root) {
    void* library = load_module(root + "/modules/graphic/ssggraph.so", "ssggraph", &graphics);
    find_symbol(library, "grContext", camera);
    find_symbol(library, "_Z11grDrawScenev", draw_scene);
    find_symbol(library, "_Z11grInitScenev", init_scene);
    find_symbol(library, "SunAnchor", sun);
}

// Loads tracks/road/<name>/<name>.xml and the mesh that it names.
void load_world(const std::string& name) {
    if (has_world) graphics.shutdowntrack();
    std::string file = "tracks/road/" + name + "/" + name + ".xml";
    if (access(file.c_str(), R_OK) != 0) fail("no world " + file);
    free(const_cast<char*>(world.filename));
    free(const_cast<char*>(world.internalname));
    world = {};
    world.filename = strdup(file.c_str());
    world.internalname = strdup(name.c_str());
    world.category = "road";
    world.graphic.bgtype = -1;  // none: the mesh has the sky
    static const char* reflections[] = {"env.png"};  // of bodies of cars, without which loading crashes
    world.graphic.env = reflections;
    world.graphic.envnb = 1;
    graphics.inittrack(&world);
    init_scene();
    (*sun)->removeAllKids();  // no lens flare
    has_world = true;
}

struct View {
    float matrix[4][4];  // rows right, forward, up and position, as PLIB multiplies
    float across, down;  // fields of view, degrees
    uint32_t top, bottom;
};

void draw(const View& view) {
    if (!has_world) fail("no world is loaded");
    if (view.top >= view.bottom || view.bottom > static_cast<uint32_t>(height)) fail("no such rows");
    static std::vector<unsigned char> image;
    GLsizei rows = static_cast<GLsizei>(view.bottom - view.top), lowest = height - static_cast<GLint>(view.bottom);
    image.resize(static_cast<size_t>(width) * rows * 3);
    sgMat4 matrix;
    memcpy(matrix, view.matrix, sizeof matrix);
    camera->setFOV(view.across, view.down);
    camera->setNearFar(NEAR, FAR);
    camera->setCamera(matrix);
    glBindFramebuffer(GL_FRAMEBUFFER, drawn);
    glViewport(0, 0, width, height);
    glEnable(GL_SCISSOR_TEST);
    glScissor(0, lowest, width, rows);
    glDepthFunc(GL_LEQUAL);
    glDepthMask(GL_TRUE);
    glClear(GL_COLOR_BUFFER_BIT | GL_DEPTH_BUFFER_BIT);
    draw_scene();
    glBindFramebuffer(GL_DRAW_FRAMEBUFFER, resolved);
    glBlitFramebuffer(0, 0, width, height, 0, 0, width, height, GL_COLOR_BUFFER_BIT, GL_NEAREST);
    glBindFramebuffer(GL_READ_FRAMEBUFFER, resolved);
    glPixelStorei(GL_PACK_ALIGNMENT, 1);
    glReadPixels(0, lowest, width, rows, GL_RGB, GL_UNSIGNED_BYTE, image.data());
    answer(VIEW, image.data(), image.size());
}

// ------------------------------------------------------------------------------------------------------ physics

tTrackItf tracks;
tSimItf physics;
tTrack* plane;
tCarElt car;
tCarElt* cars[1] = {&car};
tSituation situation;
tRmInfo race;
bool has_car = false;

// One straight so wide and long that no car reaches its ends; its middle becomes the origin.
void load_plane() {
    plane = tracks.trkBuild(const_cast<char*>("tracks/road/plane/plane.xml"));
    if (!plane || plane->nseg != 1) fail("the plane is not one segment");
    tTrackSeg* segment = plane->seg;
    float x = segment->length / 2, y = segment->vertex[TR_SR].y + segment->width / 2;
    for (t3Dd& corner : segment->vertex) {
        corner.x -= x;
        corner.y -= y;
    }
}

// The car's file, merged with that of its category, with some values in place of its own.
void* car_parameters(const char* name, float lock, float mass) {
    const int mode = GFPARM_RMODE_STD | GFPARM_RMODE_CREAT | GFPARM_RMODE_REREAD;
    std::string file = std::string("cars/") + name + "/" + name + ".xml";
    void* own = GfParmReadFile(file.c_str(), mode);
    const char* category = own ? GfParmGetStr(own, SECT_CAR, PRM_CATEGORY, nullptr) : nullptr;
    if (!category) fail("no car " + file);
    void* common = GfParmReadFile(("categories/" + std::string(category) + ".xml").c_str(), mode);
    void* merged = GfParmMergeHandles(common, own, GFPARM_MMODE_SRC | GFPARM_MMODE_DST | GFPARM_MMODE_RELSRC |
                                                       GFPARM_MMODE_RELDST);
    GfParmSetNum(merged, SECT_STEER, PRM_STEERLOCK, nullptr, lock);
    GfParmSetNum(merged, SECT_CAR, PRM_MASS, nullptr, mass);
    return merged;
}

struct Placing {
    char name[32];
    float lock;      // of TORCS's own steering angle, rad
    float mass;      // without fuel, kg
    float friction;  // of the plane
};

// Puts a new car at the origin of the plane, heading along +x, at rest.
void place(Placing placing) {
    placing.name[sizeof placing.name - 1] = 0;
    if (has_car) {
        physics.shutdown();
        GfParmReleaseHandle(car._carHandle);
    }
    for (tTrackSurface* surface = plane->surfaces; surface; surface = surface->next)
        surface->kFriction = placing.friction;
    memset(&car, 0, sizeof car);
    memset(&situation, 0, sizeof situation);
    memset(&race, 0, sizeof race);
    GF_TAILQ_INIT(&car._penaltyList);
    strcpy(car._name, "ds");
    strcpy(car._carName, placing.name);
    car._skillLevel = 3;  // a professional's: TORCS gives the tyres of beginners more grip while they slide
    car._carHandle = car_parameters(placing.name, placing.lock, placing.mass);
    RtInitCarPitSetup(car._carHandle, &car.pitcmd.setup, false);
    situation.cars = cars;
    situation._ncars = 1;
    situation._totLaps = 100;
    situation._raceState = RM_RACE_RUNNING;
    race.track = plane;
    race.s = &situation;
    race.carList = &car;
    physics.init(1, plane, 0.0f, 0.0f);  // no use of fuel, no damage
    car._trkPos.seg = plane->seg;
    RtTrackGlobal2Local(plane->seg, 0.0f, 0.0f, &car._trkPos, TR_LPOS_MAIN);
    car._pos_Z = 0.3f;
    physics.config(&car, &race);
    has_car = true;
    if (car._pos_X != 0.0f || car._pos_Y != 0.0f || !(car._wheelRadius(0) > 0.1f && car._wheelRadius(0) < 1.0f))
        fail("simuv2.so has another layout of cars: expected that of TORCS 1.3.7");
}

struct Pedals {
    uint32_t substeps;
    float steer, accelerator, brake;  // steer: share of the lock, left positive
    int32_t gear;
};

void advance(const Pedals& pedals) {
    if (!has_car) fail("no car is placed");
    for (uint32_t i = 0; i < pedals.substeps; i++) {
        if (!(std::fabs(car._pos_X) < PLANE_LIMIT && std::fabs(car._pos_Y) < PLANE_LIMIT))
            fail("the car left the plane");  // where TORCS would look for its segment for ever
        memset(&car.ctrl, 0, sizeof car.ctrl);
        car.ctrl.steer = pedals.steer;
        car.ctrl.accelCmd = pedals.accelerator;
        car.ctrl.brakeCmd = pedals.brake;
        car.ctrl.gear = pedals.gear;
        situation.deltaTime = SUBSTEP;
        situation.currentTime += SUBSTEP;
        physics.update(&situation, SUBSTEP, -1);
    }
}

// Pose and motion of the centre of mass in the plane, m, rad, s; angles of the right and left front wheel, rad.
void answer_state(uint32_t kind) {
    const double state[] = {car._pos_X, car._pos_Y, car._pos_Z, car._yaw, car._pitch, car._roll,
                            car._speed_x, car._speed_y, car._yaw_rate, car.priv.wheel[FRNT_RGT].relPos.az,
                            car.priv.wheel[FRNT_LFT].relPos.az, situation.currentTime};
    answer(kind, state, sizeof state);
}

// Digest of this file, which the build defines, and versions of OpenGL and its renderer.
void answer_hello() {
    auto text = [](GLenum name) { return std::string(reinterpret_cast<const char*>(glGetString(name))); };
    std::string lines = std::string(SOURCE) + "\n" + text(GL_VERSION) + ", " + text(GL_RENDERER);
    answer(HELLO, lines.data(), lines.size());
}

}  // namespace

// Arguments: folder of TORCS's libraries, columns and rows of the image, working folder with links to TORCS's data.
int main(int argc, char** argv) {
    if (argc != 5 || chdir(argv[4]) != 0) return 2;
    signal(SIGPIPE, SIG_IGN);  // a pipe that nobody reads is seen where it is written to
    answers = dup(1);
    dup2(2, 1);  // TORCS prints on standard output
    std::string root = argv[1];
    width = atoi(argv[2]);
    height = atoi(argv[3]);
    folder = argv[4];
    make_context();
    resolved = make_buffer(0);
    drawn = make_buffer(4);
    ssgInit();
    GfInit();
    checkGLFeatures();
    load_module(root + "/modules/track/track.so", "track", &tracks);
    load_module(root + "/modules/simu/simuv2.so", "simuv2", &physics);
    load_graphics(root);
    load_plane();
    for (;;) {
        Request request = next_request();
        switch (request.kind) {
            case HELLO: answer_hello(); break;
            case CAR: place(request.as<Placing>()); answer_state(CAR); break;
            case STEP: advance(request.as<Pedals>()); answer_state(STEP); break;
            case ROAD:
                load_world(std::string(request.bytes.begin(), request.bytes.end()));
                answer(ROAD, nullptr, 0);
                break;
            case VIEW: draw(request.as<View>()); break;
            default: fail("no request has kind " + std::to_string(request.kind));
        }
    }
}
