// A client of `turbopi serve`, and of any server of openpi's protocol, for C++17 on Linux. This file is all of it.
//
//     turbopi::Client policy("gpu-machine", 8000, "the API key");
//     turbopi::Map observation;
//     observation["observation/image"] = turbopi::Array::of(pixels, {224, 224, 3});  // uint8_t, RGB
//     observation["observation/state"] = turbopi::Array::of(state, {8});             // double or float
//     observation["prompt"] = std::string("pick up the black bowl");
//     turbopi::Map result = policy.infer(observation);
//     turbopi::Chunk chunk = turbopi::actions(result);  // chunk.at(row, column), in the robot's units
//
// `infer` waits for its answer, at most `answer_s`: call it on a thread of its own, and let the control loop go on with
// the actions that it has. Not for several threads at once. It has no TLS; docs/serving_security.md says what to do.
#pragma once

#include <fcntl.h>
#include <netdb.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <map>
#include <random>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <variant>
#include <vector>

namespace turbopi {

static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "arrays are sent as they lie in memory");

// The server can't be reached, went away, took too long or sent what is no answer. The next call connects anew.
struct Lost : std::runtime_error {
  using std::runtime_error::runtime_error;
};

// The server says why there are no actions: "bad observation: …", "busy: …", "late: …". The connection stays.
struct Refused : std::runtime_error {
  using std::runtime_error::runtime_error;
};

// Numbers in C order. dtype: NumPy's name, such as "<f8" or "|u1".
struct Array {
  std::string dtype;
  std::vector<size_t> shape;
  std::string data;

  template <typename T>
  static Array of(const T* values, std::vector<size_t> shape) {
    static_assert(std::is_arithmetic_v<T>, "numbers");
    size_t size = sizeof(T);
    for (size_t n : shape) size *= n;
    return {name<T>(), std::move(shape), std::string(reinterpret_cast<const char*>(values), size)};
  }

  // Its numbers; Lost if they are of another type.
  template <typename T>
  std::vector<T> as() const {
    if (dtype != name<T>()) throw Lost("an array is " + dtype + "; expected " + name<T>());
    std::vector<T> values(data.size() / sizeof(T));
    if (!values.empty()) std::memcpy(values.data(), data.data(), data.size());
    return values;
  }

 private:
  template <typename T>
  static std::string name() {
    const char whole = std::is_signed_v<T> ? 'i' : 'u';
    const char kind = std::is_same_v<T, bool> ? 'b' : std::is_floating_point_v<T> ? 'f' : whole;
    return (sizeof(T) == 1 ? "|" : "<") + std::string(1, kind) + std::to_string(sizeof(T));
  }
};

// Whatever a message may hold.
struct Value;
using Map = std::map<std::string, Value>;
using List = std::vector<Value>;
struct Value : std::variant<std::nullptr_t, bool, int64_t, double, std::string, Array, List, Map> {
  using variant::variant;
  Value(int number) : variant(int64_t{number}) {}
  Value(const char* text) : variant(std::string(text)) {}

  // What it is, as T; Lost, naming `what`, if it isn't that.
  template <typename T>
  const T& get(const std::string& what = "a value") const {
    if (const T* found = std::get_if<T>(this)) return *found;
    throw Lost(what + " is of another type than expected");
  }
};

namespace wire {  // msgpack with openpi's arrays: docs/serving_protocol.md

inline void number(std::string& out, char head, uint64_t value, int bytes) {
  out += head;
  while (bytes--) out += static_cast<char>(value >> (8 * bytes));
}

inline void text(std::string& out, const std::string& value) {
  number(out, '\xdb', value.size(), 4);
  out += value;
}

inline void bin(std::string& out, const std::string& value) {
  number(out, '\xc6', value.size(), 4);
  out += value;
}

inline void pack(std::string& out, const Value& value) {
  if (std::get_if<std::nullptr_t>(&value)) {
    out += '\xc0';
  } else if (auto flag = std::get_if<bool>(&value)) {
    out += *flag ? '\xc3' : '\xc2';
  } else if (auto whole = std::get_if<int64_t>(&value)) {
    number(out, *whole < 0 ? '\xd3' : '\xcf', static_cast<uint64_t>(*whole), 8);
  } else if (auto real = std::get_if<double>(&value)) {
    uint64_t bits;
    std::memcpy(&bits, real, 8);
    number(out, '\xcb', bits, 8);
  } else if (auto words = std::get_if<std::string>(&value)) {
    text(out, *words);
  } else if (auto array = std::get_if<Array>(&value)) {
    out += '\x84';
    bin(out, "__ndarray__"), out += '\xc3';
    bin(out, "data"), bin(out, array->data);
    bin(out, "dtype"), text(out, array->dtype);
    bin(out, "shape"), number(out, '\xdd', array->shape.size(), 4);
    for (size_t n : array->shape) number(out, '\xcf', n, 8);
  } else if (auto list = std::get_if<List>(&value)) {
    number(out, '\xdd', list->size(), 4);
    for (const Value& one : *list) pack(out, one);
  } else {
    const Map& map = std::get<Map>(value);
    number(out, '\xdf', map.size(), 4);
    for (const auto& [key, one] : map) text(out, key), pack(out, one);
  }
}

class Reader {
 public:
  explicit Reader(const std::string& data) : data_(data) {}

  Value whole() {
    Value value = read(0);
    if (at_ != data_.size()) throw Lost("bytes follow the message's end");
    return value;
  }

 private:
  static constexpr size_t kMostValues = 20000;  // each takes about 100 bytes, and may come as one

  const std::string& data_;
  size_t at_ = 0, values_ = 0;

  std::string bytes(size_t count) {
    if (count > data_.size() - at_) throw Lost("the message is cut off");
    at_ += count;
    return data_.substr(at_ - count, count);
  }

  uint64_t number(int bytes_) {
    uint64_t value = 0;
    for (unsigned char byte : bytes(bytes_)) value = value << 8 | byte;
    return value;
  }

  Value list(uint64_t count, int depth) {
    List found;
    while (count--) found.push_back(read(depth + 1));
    return found;
  }

  Value map(uint64_t count, int depth) {
    Map found;
    while (count--) {
      Value key = read(depth + 1);
      found[key.get<std::string>("a key")] = read(depth + 1);
    }
    if (found.count("__ndarray__")) return array(found);
    auto scalar = found.find("__npgeneric__");
    return scalar == found.end() ? Value(found) : found["data"];
  }

  Value array(Map& fields) {
    Array made{fields["dtype"].get<std::string>("dtype"), {}, fields["data"].get<std::string>("data")};
    if (made.dtype.size() != 3) throw Lost("an array of dtype " + made.dtype);
    size_t size = static_cast<size_t>(made.dtype[2] - '0');
    for (const Value& one : fields["shape"].get<List>("shape")) {
      const int64_t n = one.get<int64_t>("shape");
      const size_t most = size_t{1} << 40;
      if (n < 0 || (n > 0 && size > most / static_cast<size_t>(n))) throw Lost("an array's shape can't be");
      made.shape.push_back(static_cast<size_t>(n));
      size *= static_cast<size_t>(n);
    }
    if (size != made.data.size()) throw Lost("an array's data doesn't have its shape");
    return made;
  }

  Value read(int depth) {
    if (depth > 32) throw Lost("more than 32 maps and lists inside each other");
    if (++values_ > kMostValues) throw Lost("more than 20000 values in one message");
    const unsigned head = static_cast<unsigned>(number(1));
    if (head < 0x80) return int64_t{head};
    if (head < 0x90) return map(head & 15, depth);
    if (head < 0xa0) return list(head & 15, depth);
    if (head < 0xc0) return bytes(head & 31);
    if (head >= 0xe0) return int64_t{static_cast<int8_t>(head)};
    switch (head) {
      case 0xc0: return nullptr;
      case 0xc2: return false;
      case 0xc3: return true;
      case 0xc4: case 0xd9: return bytes(number(1));
      case 0xc5: case 0xda: return bytes(number(2));
      case 0xc6: case 0xdb: return bytes(number(4));
      case 0xca: {
        const uint32_t bits = static_cast<uint32_t>(number(4));
        float value;
        std::memcpy(&value, &bits, 4);
        return double{value};
      }
      case 0xcb: {
        const uint64_t bits = number(8);
        double value;
        std::memcpy(&value, &bits, 8);
        return value;
      }
      case 0xcc: case 0xcd: case 0xce: case 0xcf: return static_cast<int64_t>(number(1 << (head - 0xcc)));
      case 0xd0: return int64_t{static_cast<int8_t>(number(1))};
      case 0xd1: return int64_t{static_cast<int16_t>(number(2))};
      case 0xd2: return int64_t{static_cast<int32_t>(number(4))};
      case 0xd3: return static_cast<int64_t>(number(8));
      case 0xdc: return list(number(2), depth);
      case 0xdd: return list(number(4), depth);
      case 0xde: return map(number(2), depth);
      case 0xdf: return map(number(4), depth);
      default: throw Lost("no msgpack message of this protocol");
    }
  }
};

}  // namespace wire

// One chunk: H actions of d numbers each, all finite in float.
struct Chunk {
  size_t rows = 0, columns = 0;
  std::vector<double> values;
  double at(size_t row, size_t column) const { return values.at(row * columns + column); }
};

// The actions of an answer; Lost for what no robot may get.
inline Chunk actions(const Map& result) {
  auto found = result.find("actions");
  if (found == result.end()) throw Lost("an answer without actions");
  const Array& array = found->second.get<Array>("actions");
  if (array.shape.size() != 2 || array.data.empty()) throw Lost("actions aren't [H, d]");
  Chunk chunk{array.shape[0], array.shape[1], {}};
  if (array.dtype == "<f4") {
    for (float one : array.as<float>()) chunk.values.push_back(one);
  } else {
    chunk.values = array.as<double>();
  }
  for (double one : chunk.values) {
    if (!(std::abs(one) <= std::numeric_limits<float>::max())) throw Lost("actions aren't finite in float");
  }
  return chunk;
}

// Real-time chunking: have the answer to `observation` continue the chunk that the robot carries out.
//   last       the answer that is carried out; it was asked for with continue_chunk, or with "turbopi/model_actions"
//   carried    its actions that the robot has carried out at the observation's time
//   delay      actions that it will carry out until the new chunk is there
//   horizon    actions of a chunk before the next takes over
//   mode       one that the server's metadata offer in "real_time": "rtc", "rtc_identity" or "rtc_trained"
// Without a `last` the answer only gets what the next call needs.
inline void continue_chunk(Map& observation, const Map& last, size_t carried, int delay, int horizon,
                           const std::string& mode) {
  observation["turbopi/model_actions"] = true;
  auto found = last.find("model_actions");
  if (found == last.end()) return;
  const Array& whole = found->second.get<Array>("model_actions");
  if (whole.shape.size() != 2 || carried >= whole.shape[0]) return;  // nothing is left of it
  const size_t row = whole.data.size() / whole.shape[0];
  const std::vector<size_t> left{whole.shape[0] - carried, whole.shape[1]};
  observation["turbopi/previous"] = Array{whole.dtype, left, whole.data.substr(carried * row)};
  observation["turbopi/delay"] = delay;
  observation["turbopi/execution_horizon"] = horizon;
  observation["turbopi/mode"] = mode;
  if (auto anchor = last.find("anchor"); anchor != last.end()) observation["turbopi/anchor"] = anchor->second;
}

class Client {
 public:
  // Connects; Lost if nobody answers within `answer_s`.
  Client(std::string host, int port, std::string api_key = "", double answer_s = 30)
      : host_(std::move(host)), port_(port), key_(std::move(api_key)), answer_s_(answer_s) {
    for (const std::string& one : {host_, key_}) {
      if (one.find_first_of("\r\n") != std::string::npos) throw std::invalid_argument("a line's end in host or key");
    }
    begin();
    connect();
  }
  ~Client() { close(); }
  Client(const Client&) = delete;
  Client& operator=(const Client&) = delete;

  // What the policy says of itself: "robot", "action_horizon", "real_time", …
  const Map& metadata() const { return metadata_; }

  // The answer to an observation. Raises Refused and Lost.
  Map infer(const Map& observation) {
    begin();
    if (socket_ < 0) connect();
    catch_up();
    std::string message;
    wire::pack(message, Value(observation));
    send_frame(2, message);
    return receive();
  }

  void close() {
    if (socket_ < 0) return;
    ::send(socket_, "\x88\x82\0\0\0\0\x03\xe8", 8, MSG_NOSIGNAL);  // a close frame, 1000, if there is room for it
    drop();
  }

 private:
  static constexpr size_t kMost = size_t{64} << 20;  // bytes of an answer

  std::string host_;
  int port_;
  std::string key_;
  double answer_s_;
  int socket_ = -1;
  Map metadata_;
  std::string received_;  // bytes that came, and weren't read yet
  std::mt19937 random_{std::random_device{}()};
  std::chrono::steady_clock::time_point end_;

  void drop() {
    if (socket_ >= 0) ::close(socket_);
    socket_ = -1;
  }

  void begin() {
    end_ = std::chrono::steady_clock::now() + std::chrono::microseconds(static_cast<int64_t>(answer_s_ * 1e6));
  }

  [[noreturn]] void lose(const std::string& why) {
    drop();
    throw Lost(host_ + ":" + std::to_string(port_) + ": " + why);
  }

  // Milliseconds until the call gives up, from 0.
  int left() const {
    using std::chrono::milliseconds;
    const auto left = std::chrono::duration_cast<milliseconds>(end_ - std::chrono::steady_clock::now()).count();
    return static_cast<int>(std::clamp<int64_t>(left, 0, 1 << 30));
  }

  void wait(short what) {
    pollfd one{socket_, what, 0};
    const int most = left();
    if (most == 0 || ::poll(&one, 1, most) == 0) lose("no answer in time");
  }

  void connect() {
    received_.clear();
    addrinfo hints{}, *found = nullptr;
    hints.ai_socktype = SOCK_STREAM;
    if (::getaddrinfo(host_.c_str(), std::to_string(port_).c_str(), &hints, &found) != 0) lose("no such host");
    int error = 0;
    for (addrinfo* one = found; one != nullptr && socket_ < 0; one = one->ai_next) {
      socket_ = ::socket(one->ai_family, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
      if (socket_ < 0) continue;
      error = ::connect(socket_, one->ai_addr, one->ai_addrlen) == 0 ? 0 : errno;
      if (error == EINPROGRESS) {
        pollfd writable{socket_, POLLOUT, 0};
        socklen_t size = sizeof error;
        if (::poll(&writable, 1, left()) <= 0) error = ETIMEDOUT;
        else ::getsockopt(socket_, SOL_SOCKET, SO_ERROR, &error, &size);
      }
      if (error != 0) drop();
    }
    ::freeaddrinfo(found);
    if (socket_ < 0) lose(std::strerror(error));
    const int on = 1;
    ::setsockopt(socket_, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
    // a key and its answer of RFC 6455: that they are always the same tells the server nothing
    send_all("GET / HTTP/1.1\r\nHost: " + host_ + ":" + std::to_string(port_) +
             "\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
             "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n" +
             (key_.empty() ? "" : "Authorization: Api-Key " + key_ + "\r\n") + "\r\n");
    size_t headers;
    while ((headers = received_.find("\r\n\r\n")) == std::string::npos) {
      if (received_.size() > 65536) lose("no websocket server");
      read_some();
    }
    const std::string answer = received_.substr(0, headers);
    received_.erase(0, headers + 4);
    if (answer.compare(0, 12, "HTTP/1.1 101") != 0) lose("it answers " + answer.substr(0, answer.find('\r')));
    if (answer.find("s3pPLMBiTxaQ9kYGzzhZRbK+xOo=") == std::string::npos) lose("no websocket server");
    try {
      metadata_ = receive();
    } catch (const Refused& refused) {
      lose(refused.what());
    }
  }

  void read_some() {
    char buffer[65536];
    ssize_t count;
    while ((count = ::recv(socket_, buffer, sizeof buffer, 0)) < 0 && (errno == EAGAIN || errno == EINTR)) {
      wait(POLLIN);
    }
    if (count == 0) lose("the server closed the connection");
    if (count < 0) lose(std::strerror(errno));
    received_.append(buffer, static_cast<size_t>(count));
  }

  void send_all(const std::string& data) {
    for (size_t sent = 0; sent < data.size();) {
      const ssize_t count = ::send(socket_, data.data() + sent, data.size() - sent, MSG_NOSIGNAL);
      if (count >= 0) sent += static_cast<size_t>(count);
      else if (errno == EAGAIN || errno == EINTR) wait(POLLOUT);
      else lose(std::strerror(errno));
    }
  }

  void send_frame(int kind, const std::string& data) {
    std::string frame(1, static_cast<char>(0x80 | kind));
    if (data.size() < 126) frame += static_cast<char>(0x80 | data.size());
    else if (data.size() < 65536) wire::number(frame, '\xfe', data.size(), 2);
    else wire::number(frame, '\xff', data.size(), 8);
    const uint32_t mask = static_cast<uint32_t>(random_());
    char key[4];
    std::memcpy(key, &mask, 4);
    frame.append(key, 4);
    const size_t start = frame.size();
    frame += data;
    for (size_t i = 0; i < data.size(); ++i) frame[start + i] = static_cast<char>(frame[start + i] ^ key[i & 3]);
    send_all(frame);
  }

  std::string take(size_t count) {
    while (received_.size() < count) read_some();
    std::string taken = received_.substr(0, count);
    received_.erase(0, count);
    return taken;
  }

  struct Frame {
    int opcode;
    bool last;
    std::string data;
  };

  // One frame of at most `most` bytes. Pings are answered.
  Frame frame(size_t most) {
    if (left() == 0) lose("no answer in time");  // also if pings come without end
    const std::string head = take(2);
    if (head[1] & 0x80) lose("a masked frame");
    uint64_t size = head[1] & 0x7f;
    if (size > 125) {
      uint64_t longer = 0;
      for (unsigned char byte : take(size == 126 ? 2 : 8)) longer = longer << 8 | byte;
      size = longer;
    }
    if (size > most) lose("an answer of more than 64 MB");
    Frame found{head[0] & 15, (head[0] & 0x80) != 0, take(static_cast<size_t>(size))};
    const std::string& data = found.data;
    if (found.opcode == 8) lose("the server closed the connection" + (data.size() > 2 ? ": " + data.substr(2) : ""));
    if (found.opcode == 9) send_frame(10, data);
    return found;
  }

  // What came since the last answer. Another answer would be taken for the next call's, and each later one, too.
  void catch_up() {
    pollfd one{socket_, POLLIN, 0};
    while (!received_.empty() || ::poll(&one, 1, 0) > 0) {
      if (frame(kMost).opcode < 8) lose("an answer that nobody asked for");
    }
  }

  // One message; frames may be parts of it, or pings between them.
  Map receive() {
    std::string message;
    int kind = 0;
    for (bool whole = false; !whole;) {
      const Frame next = frame(kMost - message.size());
      if (next.opcode >= 8) continue;
      if (next.opcode != 0) kind = next.opcode;
      message += next.data;
      whole = next.last;
    }
    if (kind == 1) throw Refused(message);
    try {
      return wire::Reader(message).whole().get<Map>("the answer");
    } catch (const Lost& error) {
      lose(error.what());
    }
  }
};

}  // namespace turbopi
