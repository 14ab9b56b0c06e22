// Asks `turbopi serve` for a few chunks, each joined to the one before where the server can.
//
//     turbopi serve --random-weights pi05_tiny &       # or your checkpoint
//     g++ -std=c++17 -O2 examples/cpp/client.cpp -o client && ./client localhost 8000
#include <cstdio>
#include <cstdlib>

#include "turbopi.hpp"

int main(int count, char** words) try {
  const std::string host = count > 1 ? words[1] : "localhost", key = count > 3 ? words[3] : "";
  turbopi::Client policy(host, count > 2 ? std::atoi(words[2]) : 8000, key);
  std::string mode;
  if (auto found = policy.metadata().find("real_time"); found != policy.metadata().end()) {
    const auto& modes = found->second.get<turbopi::Map>("real_time").at("modes").get<turbopi::List>("modes");
    if (!modes.empty()) mode = modes[0].get<std::string>("a mode");
  }
  std::vector<uint8_t> image(224 * 224 * 3, 128);  // your camera's pixels, RGB
  std::vector<double> state(8, 0.1);               // your encoders
  turbopi::Map last;
  for (int call = 0; call < 3; ++call) {
    turbopi::Map observation;
    observation["observation/image"] = turbopi::Array::of(image.data(), {224, 224, 3});
    observation["observation/wrist_image"] = turbopi::Array::of(image.data(), {224, 224, 3});
    observation["observation/state"] = turbopi::Array::of(state.data(), {state.size()});
    observation["prompt"] = "pick up the black bowl";
    if (!mode.empty()) turbopi::continue_chunk(observation, last, 5, 2, 5, mode);
    try {
      last = policy.infer(observation);
    } catch (const turbopi::Refused& refused) {
      std::printf("no actions: %s\n", refused.what());  // the robot holds
      continue;
    }
    const turbopi::Chunk chunk = turbopi::actions(last);
    const auto found = last.find("real_time");
    const bool joined = found != last.end() && found->second.get<turbopi::Map>().at("joined").get<bool>();
    std::printf("%zu actions of %zu numbers, the first %.3f%s\n", chunk.rows, chunk.columns, chunk.at(0, 0),
                joined ? ", joined" : "");
  }
  return 0;
} catch (const turbopi::Lost& lost) {
  std::fprintf(stderr, "%s\n", lost.what());
  return 1;
}
