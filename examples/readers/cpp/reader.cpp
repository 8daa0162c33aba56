// Reads dappled's slices: reader ENDPOINT
// g++ -std=c++17 -O2 reader.cpp -o reader -lzmq      (Debian: libzmq3-dev, nlohmann-json3-dev)
#include <complex>
#include <cstdio>
#include <cstring>
#include <nlohmann/json.hpp>
#include <string>
#include <vector>
#include <zmq.h>

static bool receive(void *socket, std::vector<char> &part) {  // true while more parts follow
    zmq_msg_t message;
    zmq_msg_init(&message);
    if (zmq_msg_recv(&message, socket, 0) < 0) throw std::runtime_error(zmq_strerror(zmq_errno()));
    const char *data = static_cast<const char *>(zmq_msg_data(&message));
    part.assign(data, data + zmq_msg_size(&message));
    const bool more = zmq_msg_more(&message);
    zmq_msg_close(&message);
    return more;
}

int main(int, char **arguments) {
    void *stream = zmq_socket(zmq_ctx_new(), ZMQ_SUB);
    const int waiting = 8;  // messages that may wait here; the default of 1000 would be gigabytes
    zmq_setsockopt(stream, ZMQ_RCVHWM, &waiting, sizeof waiting);
    for (const char *topic : {"slices", "end"}) zmq_setsockopt(stream, ZMQ_SUBSCRIBE, topic, std::strlen(topic));
    if (zmq_connect(stream, arguments[1]) != 0) return std::perror(arguments[1]), 1;

    std::vector<char> topic, text, body;
    for (long expected = -1;;) {
        body.clear();
        receive(stream, topic);
        if (receive(stream, text)) receive(stream, body);
        const auto header = nlohmann::json::parse(text.begin(), text.end());
        if (std::string(topic.begin(), topic.end()) == "end") return 0;
        const long seq = header["seq"];
        if (expected >= 0 && seq != expected) std::fprintf(stderr, "missed %ld messages\n", seq - expected);
        expected = seq + 1;
        const auto &array = header["arrays"][0];  // slices: complex64 (K, h, w), little endian, C order
        const std::vector<size_t> shape = array["shape"];
        std::vector<std::complex<float>> values(shape[0] * shape[1] * shape[2]);
        if (array["dtype"] != "<c8" || body.size() != values.size() * sizeof values[0]) return 2;
        std::memcpy(values.data(), body.data(), body.size());
        double sum = 0;
        for (size_t i = 0; i < shape[1] * shape[2]; i++) sum += values[i].real();
        std::printf("frame %ld %s %zux%zux%zu mean %.6f\n", header["frame"].get<long>(),
                    array["name"].get<std::string>().c_str(), shape[0], shape[1], shape[2], sum / (shape[1] * shape[2]));
        std::fflush(stdout);
    }
}
