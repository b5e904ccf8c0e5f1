// A ROS node with eProsima Fast DDS: what it receives on one topic it publishes on another.
//
//     peer DOMAIN KIND:FROM:TO[:latched] …
//
// KIND is a type of kinds.inc, such as PoseStamped; FROM and TO are ROS topics. It uses the loopback interface alone,
// prints a line when it has started and one for each message, and ends with its standard input.

#include <cstdlib>
#include <iostream>
#include <limits>
#include <memory>
#include <mutex>
#include <sstream>
#include <string>
#include <vector>

#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <fastrtps/utils/IPLocator.h>

#include "TypesPubSubTypes.h"

using namespace eprosima::fastdds::dds;

namespace {

std::mutex printing;

void print(const std::string& line) {
    std::lock_guard<std::mutex> lock(printing);
    std::cout << line << std::endl;
}

class Link {
public:
    virtual ~Link() = default;
};

template <class Sample, class Support>
class Echo : public Link, public DataReaderListener {
public:
    Echo(DomainParticipant* domain, const std::string& from, const std::string& to, bool latched) : from_(from) {
        TypeSupport type(new Support());
        type.register_type(domain);
        Topic* there = domain->create_topic("rt" + to, type.get_type_name(), TOPIC_QOS_DEFAULT);
        Topic* here = domain->create_topic("rt" + from, type.get_type_name(), TOPIC_QOS_DEFAULT);
        DataWriterQos out = DATAWRITER_QOS_DEFAULT;
        DataReaderQos in = DATAREADER_QOS_DEFAULT;
        out.reliability().kind = in.reliability().kind = RELIABLE_RELIABILITY_QOS;
        out.durability().kind = in.durability().kind = latched ? TRANSIENT_LOCAL_DURABILITY_QOS : VOLATILE_DURABILITY_QOS;
        out.history().depth = in.history().depth = 10;
        writer_ = domain->create_publisher(PUBLISHER_QOS_DEFAULT)->create_datawriter(there, out);
        domain->create_subscriber(SUBSCRIBER_QOS_DEFAULT)->create_datareader(here, in, this);
    }

    void on_data_available(DataReader* reader) override {
        Sample sample;
        SampleInfo info;
        while (reader->take_next_sample(&sample, &info) == ReturnCode_t::RETCODE_OK) {
            if (info.valid_data) {
                writer_->write(&sample);
                print("received " + from_);
            }
        }
    }

private:
    std::string from_;
    DataWriter* writer_ = nullptr;
};

DomainParticipant* participant(int domain) {
    DomainParticipantQos qos = PARTICIPANT_QOS_DEFAULT;
    auto udp = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
    udp->interfaceWhiteList.push_back("127.0.0.1");
    qos.transport().use_builtin_transports = false;
    qos.transport().user_transports.push_back(udp);
    for (int index = 0; index < 20; ++index) {  // participants of this machine: no multicast
        eprosima::fastrtps::rtps::Locator_t locator;
        locator.kind = LOCATOR_KIND_UDPv4;
        eprosima::fastrtps::rtps::IPLocator::setIPv4(locator, 127, 0, 0, 1);
        locator.port = 7400 + 250 * domain + 10 + 2 * index;
        qos.wire_protocol().builtin.initialPeersList.push_back(locator);
    }
    return DomainParticipantFactory::get_instance()->create_participant(domain, qos);
}

std::unique_ptr<Link> link(DomainParticipant* domain, const std::string& argument) {
    std::vector<std::string> parts;
    std::stringstream text(argument);
    for (std::string part; std::getline(text, part, ':');) parts.push_back(part);
    const bool latched = parts.size() > 3;
#define KIND(name, type) \
    if (parts.at(0) == #name) return std::make_unique<Echo<type, type##PubSubType>>(domain, parts.at(1), parts.at(2), latched);
#include "kinds.inc"
#undef KIND
    std::cerr << "unknown type: " << argument << std::endl;
    std::exit(2);
}

}  // namespace

int main(int count, char** arguments) {
    if (count < 3) return 2;
    DomainParticipant* domain = participant(std::atoi(arguments[1]));
    if (domain == nullptr) return 1;
    std::vector<std::unique_ptr<Link>> links;
    for (int index = 2; index < count; ++index) links.push_back(link(domain, arguments[index]));
    print("ready");
    std::cin.ignore(std::numeric_limits<std::streamsize>::max());
    std::_Exit(0);
}
