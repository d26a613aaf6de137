-- Appends segments in one round trip: all or nothing, in the order given.
--
-- For each segment: lock its stream's head (all heads first, in a fixed order, so that two appends
-- cannot wait for each other in a circle), acknowledge what is already there, refuse what conflicts,
-- chain the hash. Positions come from a one-row counter as the last step before commit, so they are
-- gapless and in commit order; the row lock on the counter is held until commit.
--
-- p_expected: the stream's sequence before this append, or null to append wherever it stands.
-- p_chain:    the chain hash that must come out, or null; a replica's appends give it.
-- Errors:     VA001 the stream stands elsewhere; VA002 other bytes at the same place;
--             VA003 the chain hash comes out different. DETAIL is JSON.
create or replace function append_segments(
  p_epoch          integer[],
  p_station        text[],
  p_source         text[],
  p_type           text[],
  p_expected       bigint[],
  p_event_count    integer[],
  p_schema_version integer[],
  p_time_min       timestamptz[],
  p_time_max       timestamptz[],
  p_producer       text[],
  p_version        text[],
  p_configuration  bytea[],
  p_payload        bytea[],
  p_payload_hash   bytea[],
  p_chain          bytea[]
) returns table (ordinal integer, out_position bigint, out_first_sequence bigint, out_chain_hash bytea, duplicate boolean)
language plpgsql security definer set search_path from current as $$
declare
  n          constant integer := cardinality(p_station);
  ids        bigint[] := array_fill(null::bigint, array[n]);
  firsts     bigint[] := array_fill(null::bigint, array[n]);
  chains     bytea[]  := array_fill(null::bytea, array[n]);
  fresh      boolean[] := array_fill(true, array[n]);
  new_count  integer := 0;
  head       streams;
  twin       segments;
  last_position bigint;
  now_at     timestamptz;
begin
  insert into streams (station, epoch, source, type)
    select distinct s, e, o, t from unnest(p_station, p_epoch, p_source, p_type) as u(s, e, o, t)
    where not exists (select from streams x where x.station = s and x.epoch = e and x.source = o and x.type = t)
    order by 1, 2, 3, 4
    on conflict do nothing;
  perform from streams x
    where (x.station, x.epoch, x.source, x.type)
      in (select s, e, o, t from unnest(p_station, p_epoch, p_source, p_type) as u(s, e, o, t))
    order by x.id for update;

  for i in 1 .. n loop
    select * into strict head from streams x
      where x.station = p_station[i] and x.epoch = p_epoch[i] and x.source = p_source[i] and x.type = p_type[i];
    ids[i] := head.id;
    if p_expected[i] is not null and p_expected[i] <> head.sequence then
      select * into twin from segments g
        where g.stream_id = head.id and g.first_sequence <= p_expected[i] + 1
        order by g.first_sequence desc limit 1;
      if p_expected[i] > head.sequence or twin.first_sequence is null
         or twin.first_sequence + twin.event_count - 1 < p_expected[i] + 1 then
        raise exception 'stream % stands at %, expected %', head.id, head.sequence, p_expected[i]
          using errcode = 'VA001', detail = json_build_object('index', i - 1, 'actual', head.sequence);
      elsif twin.first_sequence <> p_expected[i] + 1 or twin.payload_hash <> p_payload_hash[i] then
        raise exception 'stream % holds other bytes from %', head.id, p_expected[i] + 1
          using errcode = 'VA002', detail = json_build_object('index', i - 1, 'actual', head.sequence,
            'stored_hash', encode(twin.payload_hash, 'hex'), 'sent_hash', encode(p_payload_hash[i], 'hex'));
      end if;
      fresh[i] := false;
      firsts[i] := twin.first_sequence;
      chains[i] := twin.chain_hash;
    else
      firsts[i] := head.sequence + 1;
      chains[i] := sha256(head.chain_hash
        || segment_header(p_epoch[i], p_station[i], p_source[i], p_type[i], firsts[i], p_event_count[i],
             p_schema_version[i], p_time_min[i], p_time_max[i], p_producer[i], p_version[i], p_configuration[i])
        || p_payload_hash[i]);
      new_count := new_count + 1;
      update streams set sequence = sequence + p_event_count[i], chain_hash = chains[i] where id = head.id;
    end if;
    if p_chain[i] is not null and p_chain[i] <> chains[i] then
      raise exception 'stream %: chain hash differs from %', head.id, firsts[i]
        using errcode = 'VA003', detail = json_build_object('index', i - 1, 'first_sequence', firsts[i]);
    end if;
  end loop;

  if new_count > 0 then
    -- Read under the lock, and never earlier than the last one, so that it follows the order of positions
    -- though the clock be set back.
    update log_head set position = position + new_count, recorded_at = greatest(recorded_at, clock_timestamp())
      returning position, recorded_at into last_position, now_at;
    insert into segments (position, stream_id, first_sequence, event_count, schema_version, time_min, time_max,
        recorded_at, producer, producer_version, configuration_hash, payload, payload_hash, chain_hash)
      select last_position - new_count + row_number() over (order by i), ids[i], firsts[i], p_event_count[i],
        p_schema_version[i], p_time_min[i], p_time_max[i], now_at, p_producer[i], p_version[i], p_configuration[i],
        p_payload[i], p_payload_hash[i], chains[i]
      from generate_series(1, n) as i where fresh[i];
    perform pg_notify('vian_log', last_position::text);
  end if;

  return query
    select i, g.position, firsts[i], chains[i], not fresh[i]
    from generate_series(1, n) as i
    join segments g on g.stream_id = ids[i] and g.first_sequence = firsts[i]
    order by i;
end $$;
