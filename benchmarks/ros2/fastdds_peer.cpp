// A peer that shares no line with palpate: sensor_msgs/JointState over Debian's eProsima Fast DDS.
//
//   fastdds_peer echo  DOMAIN TOPIC   answer every message on TOPIC by the same on TOPIC_echo, until killed
//   fastdds_peer robot DOMAIN TOPIC   publish best effort at 100 Hz, as many drivers do, until killed
//   fastdds_peer giant DOMAIN TOPIC   publish 20 times a second: a good message, one with a name of 1 MB, one of
//                                     100 000 numbers, one whose length field lies; until killed
//
// Lines on stdout say "up" when others may start, "ready" when the other side is there.
#include <fastcdr/Cdr.h>
#include <fastcdr/FastBuffer.h>

#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <functional>
#include <memory>
#include <string>
#include <thread>
#include <vector>

namespace fast = eprosima::fastdds::dds;
namespace cdr = eprosima::fastcdr;
namespace rtps = eprosima::fastrtps::rtps;

struct JointState {
  int32_t sec = 0;
  uint32_t nanosec = 0;
  std::string frame_id;
  std::vector<std::string> name;
  std::vector<double> position, velocity, effort;
  bool lie = false;  // the number of names says 2^32 - 1
};

class JointStateType : public fast::TopicDataType {
 public:
  JointStateType() {
    setName("sensor_msgs::msg::dds_::JointState_");
    m_typeSize = 8'000'000;
    m_isGetKeyDefined = false;
  }
  bool serialize(void* data, rtps::SerializedPayload_t* payload) override {
    const auto& m = *static_cast<JointState*>(data);
    cdr::FastBuffer buffer(reinterpret_cast<char*>(payload->data), payload->max_size);
    cdr::Cdr out(buffer, cdr::Cdr::DEFAULT_ENDIAN, cdr::Cdr::DDS_CDR);
    payload->encapsulation = out.endianness() == cdr::Cdr::BIG_ENDIANNESS ? CDR_BE : CDR_LE;
    try {
      out.serialize_encapsulation();
      out << m.sec << m.nanosec << m.frame_id;
      if (m.lie) {
        out << uint32_t{0xFFFFFFFF};
      } else {
        out << m.name << m.position << m.velocity << m.effort;
      }
    } catch (const cdr::exception::Exception& e) {
      std::fprintf(stderr, "serialize: %s\n", e.what());
      return false;
    }
    payload->length = static_cast<uint32_t>(out.getSerializedDataLength());
    return true;
  }
  bool deserialize(rtps::SerializedPayload_t* payload, void* data) override {
    auto& m = *static_cast<JointState*>(data);
    cdr::FastBuffer buffer(reinterpret_cast<char*>(payload->data), payload->length);
    cdr::Cdr in(buffer, cdr::Cdr::DEFAULT_ENDIAN, cdr::Cdr::DDS_CDR);
    try {
      in.read_encapsulation();
      payload->encapsulation = in.endianness() == cdr::Cdr::BIG_ENDIANNESS ? CDR_BE : CDR_LE;
      in >> m.sec >> m.nanosec >> m.frame_id >> m.name >> m.position >> m.velocity >> m.effort;
    } catch (const cdr::exception::Exception& e) {
      std::fprintf(stderr, "deserialize: %s\n", e.what());
      return false;
    }
    return true;
  }
  std::function<uint32_t()> getSerializedSizeProvider(void* data) override {
    return [data] {
      const auto& m = *static_cast<JointState*>(data);
      std::size_t size = 256 + m.frame_id.size() + 8 * (m.position.size() + m.velocity.size() + m.effort.size());
      for (const auto& n : m.name) size += n.size() + 16;
      return static_cast<uint32_t>(size);
    };
  }
  void* createData() override { return new JointState; }
  void deleteData(void* data) override { delete static_cast<JointState*>(data); }
  bool getKey(void*, rtps::InstanceHandle_t*, bool) override { return false; }
};

static void say(const char* text) {
  std::puts(text);
  std::fflush(stdout);
}

template <class Matched>
static void await(Matched matched) {
  while (!matched()) std::this_thread::sleep_for(std::chrono::milliseconds(5));
  say("ready");
}

int main(int argc, char** argv) {
  if (argc < 4) {
    std::fprintf(stderr, "usage: fastdds_peer echo|robot|giant DOMAIN TOPIC\n");
    return 2;
  }
  const std::string mode = argv[1], topic = argv[3];
  // loopback alone, as rmw_fastrtps does where ROS_LOCALHOST_ONLY=1
  auto loopback = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
  loopback->interfaceWhiteList.emplace_back("127.0.0.1");
  fast::DomainParticipantQos local = fast::PARTICIPANT_QOS_DEFAULT;
  local.transport().use_builtin_transports = false;
  local.transport().user_transports.push_back(loopback);
  auto* participant =
      fast::DomainParticipantFactory::get_instance()->create_participant(std::atoi(argv[2]), local);
  if (participant == nullptr) return 1;
  // bound to 127.0.0.1 its ports do not keep others off 0.0.0.0: whoever comes second must see them taken
  say("up");
  fast::TypeSupport type(new JointStateType());
  type.register_type(participant);
  auto* subscriber = participant->create_subscriber(fast::SUBSCRIBER_QOS_DEFAULT);
  auto* publisher = participant->create_publisher(fast::PUBLISHER_QOS_DEFAULT);

  fast::DataWriterQos writing = fast::DATAWRITER_QOS_DEFAULT;
  writing.reliability().kind = mode == "robot" ? fast::BEST_EFFORT_RELIABILITY_QOS : fast::RELIABLE_RELIABILITY_QOS;
  writing.history().kind = fast::KEEP_LAST_HISTORY_QOS;
  writing.history().depth = 10'000;
  writing.resource_limits().max_samples = 20'000;
  writing.resource_limits().max_samples_per_instance = 10'000;
  writing.endpoint().history_memory_policy = rtps::DYNAMIC_RESERVE_MEMORY_MODE;
  // what is larger than a datagram must be sent by another thread
  writing.publish_mode().kind = mode == "giant" ? fast::ASYNCHRONOUS_PUBLISH_MODE : fast::SYNCHRONOUS_PUBLISH_MODE;
  fast::DataReaderQos reading = fast::DATAREADER_QOS_DEFAULT;
  reading.reliability().kind = fast::RELIABLE_RELIABILITY_QOS;
  reading.history().kind = fast::KEEP_LAST_HISTORY_QOS;
  reading.history().depth = 10'000;
  reading.resource_limits().max_samples = 20'000;
  reading.resource_limits().max_samples_per_instance = 10'000;
  reading.endpoint().history_memory_policy = rtps::DYNAMIC_RESERVE_MEMORY_MODE;

  const std::string out_name = "rt" + topic + (mode == "echo" ? "_echo" : "");
  auto* out_topic = participant->create_topic(out_name, type.get_type_name(), fast::TOPIC_QOS_DEFAULT);
  auto* writer = publisher->create_datawriter(out_topic, writing);
  fast::PublicationMatchedStatus status;
  const auto read = [&] { return writer->get_publication_matched_status(status), status.current_count > 0; };

  if (mode == "echo") {
    auto* in_topic = participant->create_topic("rt" + topic, type.get_type_name(), fast::TOPIC_QOS_DEFAULT);
    auto* reader = subscriber->create_datareader(in_topic, reading);
    fast::SubscriptionMatchedStatus heard;
    await([&] { return read() && (reader->get_subscription_matched_status(heard), heard.current_count > 0); });
    JointState m;
    fast::SampleInfo info;
    for (;;) {
      if (!reader->wait_for_unread_message(eprosima::fastrtps::Duration_t(1, 0))) continue;
      while (reader->take_next_sample(&m, &info) == ReturnCode_t::RETCODE_OK) {
        if (info.valid_data) writer->write(&m);
      }
    }
  }
  await(read);
  JointState m;
  m.frame_id = "fastdds";
  for (int i = 7; i >= 1; --i) m.name.push_back("A" + std::to_string(i));  // not in the arm's order
  m.position = {0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1};
  m.effort = {7.0, 6.0, 5.0, 4.0, 3.0, 2.0, 1.0};
  const auto send = [&](JointState& message, int at) {
    message.sec = 100 + at / 100;
    message.nanosec = static_cast<uint32_t>(at % 100) * 10'000'000U;
    writer->write(&message);
  };
  if (mode == "robot") {
    for (int i = 0;; ++i) {
      send(m, i);
      std::this_thread::sleep_for(std::chrono::milliseconds(10));
    }
  }
  for (int i = 0;; ++i) {
    JointState name = m, numbers = m, lie = m;
    name.name[0] = std::string(1'000'000, 'x');
    numbers.position.assign(100'000, 1.0);
    lie.lie = true;
    for (auto* message : {&m, &name, &numbers, &lie}) send(*message, i);
    std::this_thread::sleep_for(std::chrono::milliseconds(50));
  }
}
